"""One step's excitation: place, lock, warm up, centre, record, and stop at a safe point."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from protocols.engine.excited_joint import ExcitedJoint
from protocols.engine.locking import Hold, JointLock, lock, lock_movement, move, placement
from protocols.engine.playback import Playback
from protocols.engine.session import Session
from protocols.engine.settings import ENGINE
from protocols.engine.states import EngineState, ProtocolAborted, StateMachine
from protocols.steps.parts import CLOSED, Place
from protocols.steps.plans import LockPlan, StepPlan
from rig.bench.guard import EXCITED, FREE, JointRole
from rig.runs.recorder import RecordMeta

log = logging.getLogger(__name__)


class ExcitationEngine(Protocol):
    """The engine's interface for an excitation."""

    @property
    def machine(self) -> StateMachine:
        """The state of the run."""

    @property
    def interrupted(self) -> bool:
        """Whether a person has requested a pause, or to skip the step."""

    def report_phase(self, step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
        """Receive the progress of the step."""


class ExcitationRun:
    """The excitation of one step, from rest to rest, repeated after each interruption."""

    def __init__(
        self,
        session: Session,
        place: Place,
        step: StepPlan,
        engine: ExcitationEngine,
        first_repeat: int = 1,
        attributes: Mapping[str, str] | None = None,
    ) -> None:
        """Number the records from `first_repeat`; `attributes` are stored with each."""
        self.session = session
        self.place = place
        self.step = step
        self.taken = 0  # complete records
        self._engine = engine
        self._first = first_repeat
        self._extra = dict(attributes or {})
        self._hold = Hold(step.name, step.settle, step.record / session.rate)
        self.locks: list[JointLock] = []

    def report_phase(self, phase: str, message: str, repeat: int = 0) -> None:
        """Report a phase."""
        log.info("%s: %s %s", self.step.name, phase, message)
        self._engine.report_phase(self.step.name, phase, repeat, self.step.repeats, message)

    def run(self) -> bool:
        """Take the missing records; return False where a person requested a stop."""
        excitation = self._start()
        self.report_phase("centre", "open loop; biases are trimmed")
        excitation.settle_bias()
        complete = self._records(excitation)
        self._stop(excitation)
        return complete

    def move_until(self, reached: Callable[[], bool], longest: float) -> bool:
        """Excite without records until `reached()`; False after `longest` seconds or a stop."""
        excitation = self._start()
        excitation.hold()
        began, stop = self.session.now, reached()
        while not stop and not self._engine.interrupted:
            if self.session.now - began >= longest * self.session.rate:
                break
            excitation.go_on(ENGINE.look_seconds)
            stop = reached()
        self._stop(excitation)
        return stop

    def _start(self) -> Playback:
        """Position and lock the joints, and let the waveforms grow."""
        self._engine.machine.to(EngineState.HOMING, self.step.name)
        self.session.bench.guard(self._roles(moving=True))
        nulls = self._place()
        self.locks = self._lock()
        self.session.bench.guard(self._roles())
        self._engine.machine.to(EngineState.EXCITING, self.step.name)
        excitation = Playback(self.session, self.step, self.place, self.locks)
        self.report_phase("warm-up", "waveforms grow under the position loop")
        excitation.warm_up(nulls)
        return excitation

    def _stop(self, excitation: Playback) -> None:
        self.report_phase("stop", "waveforms shrink, valves close")
        excitation.stop()
        self._engine.machine.to(EngineState.IDLE, f"{self.step.name}: valves closed")
        self.locks = []
        self.session.bench.guard(self._roles(moving=True))

    def _roles(self, moving: bool = False) -> list[JointRole]:
        """Return the role of each joint; a joint in transit may touch the ends of its stroke."""
        roles = [FREE] * self.session.joints
        if moving:
            return roles
        for part in self.step.excite:
            roles[part.joint] = EXCITED
        for held in self.locks:
            tolerance = ENGINE.guard_share * held.tolerance
            roles[held.joint] = JointRole(locked_at=held.piston, tolerance=tolerance)
        return roles

    def _place(self) -> dict[int, float]:
        targets = {e.joint: e.centre for e in self.step.excite}
        where = ", ".join(f"joint {j + 1} to {1e3 * s:g} mm" for j, s in targets.items())
        self.report_phase("place", where)
        self.session.wait(0.01)  # to obtain the device's time
        # They are centred again once excited: half of the offset allowed then is enough here.
        half_offset = 0.5 * min(e.settings.centring.offset for e in self.step.excite)
        tolerance = max(self.place.tolerance, half_offset)
        settle, name = self.step.settle, self.step.name
        return move(self.session, targets, self.place, tolerance, settle, name)

    def _lock(self) -> list[JointLock]:
        """Lock the joints: end stops first, because the push disturbs closed joints."""
        locks = []
        for part in sorted(self.step.locks, key=lambda p: p.at == CLOSED):
            self.report_phase("lock", f"joint {part.joint + 1} {_lock_text(part)}")
            locks.append(lock(self.session, part, self.place, self._hold))
            self._engine.machine.to(EngineState.LOCKED, f"joint {part.joint + 1} {part.at}")
        return locks

    def _records(self, excitation: Playback) -> bool:
        """Take records until all are complete, or a person interrupts between two of them."""
        disturbed = 0
        while self.taken < self.step.repeats:
            repeat = self._first + self.taken
            if self._record(excitation, repeat):
                self.taken += 1
                if self.taken < self.step.repeats:
                    if self._engine.interrupted:
                        return False
                    if self._relock(excitation):
                        excitation.settle_bias()
                continue
            disturbed += 1
            if disturbed > self.step.tries:
                raise ProtocolAborted(
                    f"{self.step.name}: record {repeat} was about to leave the piston limits "
                    f"{disturbed} times; lower the amplitude, or find out what makes it drift"
                )
            if self._engine.interrupted:
                return False
            self.report_phase("centre", f"record {repeat} was disturbed and is taken again", repeat)
            excitation.settle_bias()
        return True

    def _record(self, excitation: Playback, repeat: int) -> bool:
        """Take one record; return False if it was disturbed and discarded."""
        self.report_phase(
            "record", f"record {repeat} of {self._first - 1 + self.step.repeats}", repeat
        )
        first, driven = excitation.boundary, excitation.joints
        meta = self._meta(repeat)
        with self.session.bench.record(meta, start_tick=first, ticks=self.step.record) as record:
            if not excitation.record():
                record.discard("a bias had to be corrected within it")
                return False
            record.note(**self._attributes(first, driven, excitation))
        return True

    def _meta(self, repeat: int) -> RecordMeta:
        attributes: dict[str, str | float | int] = {
            **{f"parameter_{name}": value for name, value in self._extra.items()},
            "excited": " ".join(str(e.joint + 1) for e in self.step.excite),
        }
        for e in self.step.excite:
            if e.wave.detection_lines:
                lines = " ".join(str(k) for k in e.wave.detection_lines)
                attributes[f"detection_lines_{e.joint + 1}"] = lines
        return RecordMeta(
            step=self.step.name,
            repeat=repeat,
            locked=tuple(held.joint + 1 for held in self.locks),
            period=self.step.period,
            lines=self.step.lines,
            attributes=attributes,
        )

    def _attributes(
        self, first: int, driven: Sequence[ExcitedJoint], excitation: Playback
    ) -> dict[str, str | float | int]:
        """Return the attributes of a record that are known only after it."""
        attributes: dict[str, str | float | int] = {}
        last = first + self.step.record
        for held in self.locks:
            j = held.joint + 1
            attributes[f"lock_{j}"] = held.at
            attributes[f"lock_piston_m_{j}"] = held.piston
            attributes[f"lock_gain_v_per_m_{j}"] = held.law.position_gain
            attributes[f"lock_give_m_{j}"] = lock_movement(self.session, held, first, last)
        for before, after in zip(driven, excitation.joints, strict=True):
            j = before.joint + 1
            attributes[f"bias_v_{j}"] = before.bias
            attributes[f"position_gain_v_per_m_{j}"] = before.loop
            attributes[f"drift_m_{j}"] = after.moved.drift * self.step.record / self.session.rate
            attributes[f"centre_m_{j}"] = after.moved.mean
        return attributes

    def _relock(self, excitation: Playback) -> bool:
        """Close again each valve whose piston crept too far; return whether there was one."""
        changed = False
        for n, held in enumerate(self.locks):
            if held.at != CLOSED:
                continue
            first = self.session.now - self.step.period
            reading = placement(self.session, held.joint, first, self.session.now)
            creep = reading.piston - held.piston
            if abs(creep) <= ENGINE.relock_share * held.tolerance:
                continue
            self.report_phase(
                "lock", f"joint {held.joint + 1} crept {1e3 * creep:.2f} mm; closed anew"
            )
            plan = next(part for part in self.step.locks if part.joint == held.joint)
            excitation.hold()
            roles = self._roles()
            roles[held.joint] = FREE
            self.session.bench.guard(roles)
            self.locks[n] = lock(self.session, plan, self.place, self._hold)
            changed = True
        if changed:
            excitation.resume(self.locks)
            self.session.bench.guard(self._roles())
        return changed


def _lock_text(part: LockPlan) -> str:
    if part.at == CLOSED:
        return f"to {1e3 * part.piston:g} mm, valve closed there"
    return f"to its end stop ({part.at}), held there"
