"""Playing the waveforms of one step: warm-up, trials of the bias, records.

All boundaries are ticks: the waveforms start at `start`, and every later stretch begins a whole
number of periods after it, so all records of a step begin at the same sample of the waveform. A
law is changed when the block that holds the boundary has been read: a few samples after it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.base import OFF, OutputLaw
from protocols.centring import (
    RECENTRE_CAP,
    Motion,
    follow,
    forecast,
    leaves,
    motion,
    moved_by,
    recentring,
    trim,
)
from protocols.errors import ProtocolAborted
from protocols.locking import Lock, verify
from protocols.model import OPEN_LOOP, Place
from protocols.plan import ExcitePlan, StepPlan
from protocols.session import Session

log = logging.getLogger(__name__)

RAMP_STEP = 0.05  # [s] between two sizes of the growing waveform
RAMP_DOWN = 0.5  # [s] a moving arm is not stopped by closing its valve at once
LOOK_AHEAD = 0.2  # [s] between two forecasts
FASTEST_RETURN = 3e-3  # [m/s] by which a disturbed piston is brought back


AT_REST = Motion(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Driven:
    """An excited joint: its plan, bias [V], gain k [m/(s V)], drift asked for and seen [m/s]."""

    plan: ExcitePlan
    bias: float
    gain: float
    wanted: float = 0.0
    moved: Motion = AT_REST

    @property
    def open_loop(self) -> bool:
        """Whether nothing but the bias keeps it centred while it is recorded."""
        return self.plan.settings.centring.mode == OPEN_LOOP


class Excitation:
    """One step's excitation in progress, from the first sample of its waveforms."""

    def __init__(
        self, session: Session, step: StepPlan, place: Place, locks: Sequence[Lock]
    ) -> None:
        self.session = session
        self.step = step
        self.place = place
        self.locks = tuple(locks)
        self.joints: tuple[Driven, ...] = ()
        self.start = 0
        self.at = 0  # the tick of the boundary reached
        self._checked = 0  # locks are verified up to here

    def _law(self, joint: Driven, scale: float, position_gain: float) -> OutputLaw:
        limit = self.session.rig.joints[joint.plan.joint].limits.command
        return OutputLaw(scale, joint.bias, position_gain, joint.plan.centre, limit)

    def _play(self, scale: float = 1.0, loop: float | None = None) -> None:
        """Put the laws of all excited joints in force; `loop` overrides their position gains."""
        laws = {}
        for joint in self.joints:
            own = 0.0 if joint.open_loop else joint.plan.settings.centring.position_gain
            laws[joint.plan.joint] = self._law(joint, scale, own if loop is None else loop)
        self.session.apply(laws)

    def _watch_locks(self) -> None:
        for held in self.locks:
            verify(self.session, held, self.step.name, self._checked, self.session.now)
        self._checked = self.session.now

    def _advance(self, samples: int) -> None:
        """Go on to the boundary `samples` later, with an eye on the locks."""
        self.at += samples
        self.session.until(self.at, self._watch_locks)

    def warm_up(self, nulls: Mapping[int, float]) -> None:
        """Let the waveforms grow under a firm position loop, then loosen it and find the biases.

        `nulls` [V] are the commands that held the pistons still, by joint (0-based). Raises
        ProtocolAborted for a piston that does not follow its command.
        """
        self.joints = tuple(Driven(e, nulls[e.joint], math.nan) for e in self.step.excite)
        for joint in self.joints:
            self.session.bench.upload(joint.plan.joint, joint.plan.wave.samples)
        firm = self.place.position_gain
        laws = {j.plan.joint: self._law(j, 0.0, firm) for j in self.joints}
        self.start = self.at = self.session.apply(laws, restart=True)
        self._checked = self.session.now
        sizes = max(1, round(self.step.ramp / RAMP_STEP))
        for size in range(1, sizes + 1):
            tick = self.start + round(size * RAMP_STEP * self.session.rate)
            self.session.until(tick, self._watch_locks)
            self._play(size / sizes, firm)
        firm_periods = max(
            math.ceil(self.step.ramp * self.session.rate / self.step.period),
            self.step.warm_up // self.step.period // 2,
        )
        self._advance(firm_periods * self.step.period)
        self._find_biases(since=tick)
        self.hold()
        self._advance(self.step.warm_up - firm_periods * self.step.period)
        self._find_biases(since=self.at - self.step.period)

    def _find_biases(self, since: int) -> None:
        """Take each bias from how the piston followed its command since a tick, or a period."""
        first = max(since, self.at - self.step.period)
        found = []
        for joint in self.joints:
            j = joint.plan.joint
            command = self.session.command(j, first, self.at)
            seen = follow(command, self.session.piston(j, first, self.at), self.session.rate)
            if not seen.gain > 0.0:
                raise ProtocolAborted(
                    f"{self.step.name}: joint {j + 1} does not follow its command: "
                    f"{np.nanstd(command):.3g} V (rms) move the piston by {seen.gain:.3g} m/s "
                    "per volt, expected more than 0; is the pump on, and the valve connected "
                    "the right way round?"
                )
            found.append(replace(joint, bias=seen.null, gain=seen.gain))
            log.info(
                "%s: joint %d moves %.4f m/s per volt, null %.4f V",
                self.step.name, j + 1, seen.gain, seen.null,
            )  # fmt: skip
        self.joints = tuple(found)

    def settle_bias(self) -> None:
        """Play trials until every piston is centred and its drift is what was asked for.

        Raises ProtocolAborted after as many tries as the protocol allows.
        """
        seconds = self.step.trial / self.session.rate
        for attempt in range(self.step.tries + 1):
            self._play()
            self._advance(self.step.trial)
            moved = [self._moved(joint, alone=attempt == 0) for joint in self.joints]
            good = all(self._settled(j, m) for j, m in zip(self.joints, moved, strict=True))
            self._trim(moved, self.step.record / self.session.rate if good else seconds, good)
            if good:
                return
        self._give_up()

    def _moved(self, joint: Driven, alone: bool) -> Motion:
        """Measure the last stretch; `alone`, if the period before it ran under another law."""
        j, period, rate = joint.plan.joint, self.step.period, self.session.rate
        if alone and self.step.trial < 2 * period:
            piston = self.session.piston(j, self.at - period, self.at)
            command = self.session.command(j, self.at - period, self.at)
            seen = follow(command, piston, rate)
            drift = seen.gain * (float(np.nanmean(command)) - seen.null)
            return moved_by(piston, drift, rate)
        return motion(self.session.piston(j, self.at - 2 * period, self.at), period, rate)

    def _settled(self, joint: Driven, moved: Motion) -> bool:
        allowed = joint.plan.settings.centring
        wrong = abs(moved.drift - joint.wanted) * self.step.record / self.session.rate
        off = abs(moved.ends - joint.plan.centre)
        log.info(
            "%s: joint %d at bias %.4f V drifts %.3f mm/s (asked %.3f), centre off by %.2f mm",
            self.step.name, joint.plan.joint + 1, joint.bias, 1e3 * moved.drift,
            1e3 * joint.wanted, 1e3 * (moved.ends - joint.plan.centre),
        )  # fmt: skip
        return wrong <= allowed.drift and off <= allowed.offset

    def _trim(self, moved: Sequence[Motion], seconds: float, gently: bool) -> None:
        """Set each bias for the next `seconds`; `gently`, because that will be a record."""
        trimmed = []
        for joint, seen in zip(self.joints, moved, strict=True):
            if not joint.open_loop:
                loop = joint.plan.settings.centring.position_gain
                bias = joint.bias - loop * (seen.mean - joint.plan.centre) - seen.drift / joint.gain
                trimmed.append(replace(joint, bias=bias, moved=seen))
                continue
            cap = RECENTRE_CAP * joint.plan.settings.centring.drift if gently else math.inf
            wanted = recentring(seen, joint.plan.centre, seconds, cap)
            bias = trim(joint.bias, seen.drift, wanted, joint.gain)
            trimmed.append(replace(joint, bias=bias, wanted=wanted, moved=seen))
        self.joints = tuple(trimmed)

    def _give_up(self) -> None:
        worst = max(self.joints, key=lambda j: abs(j.moved.drift))
        allowed = worst.plan.settings.centring
        drift = worst.moved.drift * self.step.record / self.session.rate
        raise ProtocolAborted(
            f"{self.step.name}: joint {worst.plan.joint + 1} is not centred after "
            f"{self.step.tries + 1} trials: it drifts {1e3 * drift:.2f} mm in a record "
            f"(allowed {1e3 * allowed.drift:g} mm) and its centre is at "
            f"{1e3 * worst.moved.ends:.2f} mm (expected {1e3 * worst.plan.centre:g} +- "
            f"{1e3 * allowed.offset:g} mm); allow more drift, or centre by 'position-loop'"
        )

    def record(self) -> bool:
        """Play one record from the boundary reached; False if it had to be disturbed.

        The biases are trimmed for the next one from what was seen in it. When the trend would
        take a piston past its limit, its bias is corrected at once and the period finished.
        """
        self._play()
        first, last = self.at, self.at + self.step.record
        references = [
            self.session.piston(j.plan.joint, first - self.step.period, first) for j in self.joints
        ]
        while self.at < last:
            self.at = min(last, self.at + round(LOOK_AHEAD * self.session.rate))
            self.session.until(self.at, self._watch_locks)
            if self.at < last and self._correct(references, first, last):
                past = (self.at - first) % self.step.period
                self._advance(self.step.period - past if past else 0)
                return False
        moved = [self._moved(joint, alone=False) for joint in self.joints]
        self._trim(moved, self.step.record / self.session.rate, gently=True)
        return True

    def _correct(self, references: Sequence[np.ndarray], first: int, last: int) -> bool:
        """Correct the biases of pistons about to leave their limits; says whether any was."""
        changed = list(self.joints)
        for n, (joint, reference) in enumerate(zip(self.joints, references, strict=True)):
            if not joint.open_loop:
                continue
            seen = self.session.piston(joint.plan.joint, first, self.at)
            ahead = forecast(reference, seen, last - self.at, self.session.rate)
            low, high = self.session.rig.joints[joint.plan.joint].limits.piston
            if not leaves(ahead, low, high):
                continue
            drift = joint.moved.drift + ahead.slope
            off = joint.moved.mean + ahead.shift - joint.plan.centre
            back = -float(np.clip(off, -FASTEST_RETURN, FASTEST_RETURN))
            changed[n] = replace(joint, bias=trim(joint.bias, drift, back, joint.gain), wanted=back)
            log.warning(
                "%s: joint %d would reach %.1f..%.1f mm before the record ends; bias corrected",
                self.step.name, joint.plan.joint + 1, 1e3 * ahead.low, 1e3 * ahead.high,
            )  # fmt: skip
        disturbed = any(a is not b for a, b in zip(changed, self.joints, strict=True))
        self.joints = tuple(changed)
        if disturbed:
            self._play()
        return disturbed

    def hold(self) -> None:
        """Centre by the slow loop, until the next trial."""
        self._play(loop=min(j.plan.settings.centring.position_gain for j in self.joints))

    def resume(self, locks: Sequence[Lock]) -> None:
        """Go on at the next boundary with locks that were made anew meanwhile."""
        self.locks = tuple(locks)
        self._checked = self.session.now
        behind = self.session.now - self.at
        self._advance(math.ceil(behind / self.step.period) * self.step.period)

    def stop(self) -> None:
        """Let the waveforms shrink under the firm loop, then close every valve."""
        sizes = round(RAMP_DOWN / RAMP_STEP)
        for size in range(sizes - 1, -1, -1):
            self._play(size / sizes, self.place.position_gain)
            self.session.wait(RAMP_STEP)
        self.session.apply(dict.fromkeys(range(self.session.joints), OFF))
