"""Playing the waveforms of one step: warm-up, trials of the bias, records.

All boundaries are ticks: the waveforms start at `start`, and every later stretch begins a whole
number of periods after it, so all records of a step begin at the same sample of the waveform. A law
is changed when the block with the boundary has been read, a few samples after it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from drivers.base import OutputLaw
from protocols.engine.centring import Array, Motion, follow, free_path, motion, moved_by
from protocols.engine.excited_joint import (
    ExcitedJoint,
    check_swing,
    corrected,
    found_under_loop,
    not_centred,
    off_centre,
    returned,
    settled,
    trimmed,
)
from protocols.engine.locking import JointLock, verify
from protocols.engine.session import Session
from protocols.engine.settings import ENGINE
from protocols.steps.parts import Place
from protocols.steps.plans import FIRM_SECONDS, StepPlan


class Playback:
    """One step's excitation in progress; `boundary` is the tick of the last one."""

    def __init__(
        self, session: Session, step: StepPlan, place: Place, locks: Sequence[JointLock]
    ) -> None:
        self.session = session
        self.step = step
        self.place = place
        self.locks = tuple(locks)
        self.joints: tuple[ExcitedJoint, ...] = ()
        self.start = 0
        self.boundary = 0
        self._after_other_law = True  # the last period ran under another law than this one
        self._references: list[Array] = []  # the last undisturbed period of each joint
        self._checked = 0  # locks are verified up to this tick

    def warm_up(self, nulls: Mapping[int, float]) -> None:
        """Let the waveforms grow under a firm position loop, lower its gain and find the biases.

        `nulls` [V] are the commands that held the pistons at rest, by joint (0-based). A loop
        shifts the phase of the motion, so that a sudden change would leave the piston off centre:
        the gain is lowered slowly. Raises ProtocolAborted for a piston that does not follow its
        command or swings too far.
        """
        self.joints = tuple(ExcitedJoint(e, nulls[e.joint]) for e in self.step.excite)
        for driven in self.joints:
            self.session.bench.upload(driven.joint, driven.plan.wave.samples)
        firm = self.place.position_gain
        silent = {d.joint: self._law(d, 0.0, firm) for d in self.joints}
        self.start = self.session.apply(silent, restart=True)
        self._checked = self.session.now
        self._grow(firm)
        self.go_on(FIRM_SECONDS)
        self._find_biases(round(FIRM_SECONDS * self.session.rate))
        self._play(loop=firm)
        self.go_on(0.5 * FIRM_SECONDS)
        self._loosen(firm)
        passed = self.session.now - self.start
        self.boundary = self.start + math.ceil(passed / self.step.period) * self.step.period
        for _ in range(ENGINE.warm_ups):
            self.hold()
            self._advance(self.step.warm_up)
            self._find_biases(self.step.warm_up)
            if max(off_centre(driven) for driven in self.joints) < 0.5:
                break
        self._references = self._last_period()
        for driven, period in zip(self.joints, self._references, strict=True):
            limits = self.session.rig.joints[driven.joint].limits.piston
            check_swing(driven, period, limits, self.step.name)

    def settle_bias(self) -> None:
        """Play trials until every piston is centred and has its target drift.

        Raises ProtocolAborted after as many tries as the protocol allows.
        """
        record = self.step.record / self.session.rate
        self._release()
        for _ in range(self.step.tries + 1):
            self._play()
            moved = self._play_through(self.step.trial)
            if moved is None:
                continue
            pairs = list(zip(self.joints, moved, strict=True))
            centred = all(settled(d, m, record, self.step.name) for d, m in pairs)
            seconds = record if centred else self.step.trial / self.session.rate
            self.joints = tuple(trimmed(d, m, seconds, centred) for d, m in pairs)
            if centred:
                return
        worst = max(self.joints, key=lambda d: abs(d.moved.ends - d.plan.centre))
        raise not_centred(worst, record, self.step.tries + 1, self.step.name)

    def _release(self) -> None:
        """Switch the slow loop off when each piston is on its open-loop path.

        Elsewhere it would continue off centre: for a slow waveform, whose phase a loop shifts by a
        quarter period, by as much as its whole swing. For a fast one the difference is negligible.
        """
        period, rate = self.step.period, self.session.rate
        paths = {
            d.joint: free_path(d.plan.wave.samples, period, d.gain, rate) + d.plan.centre
            for d in self.joints
            if d.loop == 0.0 and self.session.laws[d.joint].position_gain > 0.0
        }
        before = {j: self._off_path(j, path) for j, path in paths.items()}
        allowed = {d.joint: ENGINE.released_share * d.centring.offset for d in self.joints}
        if all(abs(distance) <= 2 * allowed[j] for j, distance in before.items()):
            return
        laws = {d.joint: self._law(d, 1.0, 0.0) for d in self.joints}
        while before and self.session.now < self.boundary + period:
            self.go_on(ENGINE.ramp_step)
            for j, distance in list(before.items()):
                present = self._off_path(j, paths[j])
                if abs(present) <= allowed[j] or present * distance < 0.0:
                    self.session.apply({j: laws[j]})
                    del before[j]
        self.session.apply({j: laws[j] for j in before})
        self._advance(math.ceil((self.session.now - self.boundary) / period) * period)
        self._references = [
            paths.get(d.joint, reference)
            for d, reference in zip(self.joints, self._references, strict=True)
        ]

    def _off_path(self, joint: int, path: Array) -> float:
        """Return the distance [m] of a piston from its open-loop path at the last sample."""
        now = self.session.now
        (piston,) = self.session.piston(joint, now - 1, now)
        return float(piston - path[(now - 1 - self.start) % len(path)])

    def record(self) -> bool:
        """Play one record from the last boundary; return False if it had to be disturbed.

        The biases are then trimmed by its motion for the next one.
        """
        self._play()
        moved = self._play_through(self.step.record)
        if moved is None:
            return False
        seconds = self.step.record / self.session.rate
        self.joints = tuple(
            trimmed(d, m, seconds, True) for d, m in zip(self.joints, moved, strict=True)
        )
        return True

    def hold(self) -> None:
        """Centre by the slow loop, until the next trial."""
        self._play(loop=self._slow_gain())
        self._after_other_law = True

    def resume(self, locks: Sequence[JointLock]) -> None:
        """Continue at the next boundary, with renewed locks."""
        self.locks = tuple(locks)
        self._checked = self.session.now
        behind = self.session.now - self.boundary
        self._advance(math.ceil(behind / self.step.period) * self.step.period)

    def stop(self) -> None:
        """Let the waveforms shrink under the firm loop, then close every valve."""
        sizes = round(ENGINE.ramp_down / ENGINE.ramp_step)
        for size in range(sizes - 1, -1, -1):
            self._play(size / sizes, self.place.position_gain)
            self.session.wait(ENGINE.ramp_step)
        self.session.off()

    def _law(self, driven: ExcitedJoint, scale: float, position_gain: float) -> OutputLaw:
        limit = self.session.rig.joints[driven.joint].limits.command
        return OutputLaw(scale, driven.bias, position_gain, driven.plan.centre, limit)

    def _play(self, scale: float = 1.0, loop: float | None = None) -> None:
        """Apply the laws of all excited joints; `loop` [V/m] overrides their own."""
        self.session.apply(
            {d.joint: self._law(d, scale, d.loop if loop is None else loop) for d in self.joints}
        )

    def _grow(self, loop: float) -> None:
        """Let the waveforms grow to full size."""
        sizes = max(1, round(self.step.ramp / ENGINE.ramp_step))
        for size in range(1, sizes + 1):
            self.go_on(ENGINE.ramp_step)
            self._play(size / sizes, loop)

    def _loosen(self, firm: float) -> None:
        """Lower the position gain to the slow loop's, no faster than the loop settles."""
        loop, loose = firm, self._slow_gain()
        slowest = min(d.gain for d in self.joints)
        while loop * ENGINE.loosening_factor > loose:
            loop *= ENGINE.loosening_factor
            self._play(loop=loop)
            self.go_on(0.5 / (slowest * loop))

    def _slow_gain(self) -> float:
        return min(d.centring.position_gain for d in self.joints)

    def go_on(self, seconds: float) -> None:
        """Continue for a time, to any tick, checking the locks."""
        self.session.wait(seconds, self._watch_locks)

    def _watch_locks(self) -> None:
        for held in self.locks:
            verify(self.session, held, self.step.name, self._checked, self.session.now)
        self._checked = self.session.now

    def _advance(self, samples: int) -> None:
        """Continue to the boundary `samples` later, checking the locks."""
        self.boundary += samples
        self.session.until(self.boundary, self._watch_locks)

    def _find_biases(self, samples: int) -> None:
        """Compute each bias from the last `samples`, or the last two periods if those are fewer."""
        last = self.session.now
        first = last - min(samples, 2 * self.step.period)
        self.joints = tuple(
            found_under_loop(
                driven,
                self.session.command(driven.joint, first, last),
                self.session.piston(driven.joint, first, last),
                self.step.period,
                self.session.rate,
                self.step.name,
            )
            for driven in self.joints
        )

    def _last_motion(self, driven: ExcitedJoint) -> Motion:
        """Return the motion of one joint up to the last boundary."""
        j, period, rate = driven.joint, self.step.period, self.session.rate
        if self._after_other_law and self.step.trial < 2 * period:
            piston = self.session.piston(j, self.boundary - period, self.boundary)
            command = self.session.command(j, self.boundary - period, self.boundary)
            return moved_by(piston, follow(command, piston, rate).drift, rate)
        piston = self.session.piston(j, self.boundary - 2 * period, self.boundary)
        return motion(piston, period, rate)

    def _last_period(self) -> list[Array]:
        first = self.boundary - self.step.period
        return [self.session.piston(d.joint, first, self.boundary) for d in self.joints]

    def _play_through(self, samples: int) -> list[Motion] | None:
        """Play `samples`, whole periods; return the motion of each joint.

        None if a piston was about to leave its limits: then the biases were changed at once, and
        the stretch ended with the period begun.
        """
        first, last = self.boundary, self.boundary + samples
        while self.boundary < last:
            self._advance(min(last - self.boundary, round(ENGINE.look_ahead * self.session.rate)))
            if self.boundary < last and self._correct(first, last):
                elapsed = (self.boundary - first) % self.step.period
                self._advance(self.step.period - elapsed if elapsed else 0)
                self.joints = tuple(returned(d) for d in self.joints)
                self._after_other_law = True
                return None
        moved = [self._last_motion(driven) for driven in self.joints]
        self._after_other_law = False
        self._references = self._last_period()
        return moved

    def _correct(self, first: int, last: int) -> bool:
        """Correct the biases of pistons about to leave their limits; return whether any was."""
        measured = [
            corrected(
                driven,
                reference,
                self._after_other_law,
                self.session.piston(driven.joint, first, self.boundary),
                last - self.boundary,
                self.session.rate,
                self.session.rig.joints[driven.joint].limits.piston,
                self.step.name,
            )
            for driven, reference in zip(self.joints, self._references, strict=True)
        ]
        if not any(measured):
            return False
        self.joints = tuple(new or old for new, old in zip(measured, self.joints, strict=True))
        self._play()
        return True
