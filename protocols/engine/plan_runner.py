"""The actions of steps at the bench: implements `protocols.steps.base.Actions` on a session."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from protocols.engine.excitation import ExcitationRun
from protocols.engine.locking import Hold, lock, move, placement
from protocols.engine.run_inputs import RunInputs
from protocols.engine.session import Session
from protocols.engine.settings import ENGINE
from protocols.engine.states import EngineState, ProtocolAborted, RunEnded, StateMachine
from protocols.files.plan import Plan
from protocols.language.conditions import ELAPSED, Condition
from protocols.steps.base import PlannedStep, Question
from protocols.steps.excite import Step
from protocols.steps.plans import LockPlan
from rig.bench.guard import FREE
from rig.bench.session import Bench
from rig.model.rig import Rig
from rig.model.trips import OperatorStop
from rig.runs.recorder import RecordMeta

log = logging.getLogger(__name__)

# step, phase, repeat (0 outside of records), repeats, message
OnPhase = Callable[[str, str, int, int, str], None]


class PlanRunner:
    """One run of a plan: its session, its state, steps done and remaining."""

    def __init__(
        self, plan: Plan, rig: Rig, bench: Bench, on_phase: OnPhase, inputs: RunInputs
    ) -> None:
        self.bench = bench
        self.inputs = inputs
        self.records = 0  # complete ones
        keep = max((s.record + 2 * s.period for s in plan.excitations), default=0)
        keep += round(ENGINE.spare_seconds * rig.sample_rate)
        self.session = Session(bench, rig, keep, inputs.machine, self._obey_requests)
        self._place = plan.protocol.place
        self._parts = len(plan.sequence)
        self._on_phase = on_phase
        self._complete: dict[str, int] = {}  # complete records by step
        self._at_begin: dict[str, int] = {}  # the same, when the step was begun
        self._last_record = ""
        self._part: PlannedStep | None = None
        self._part_began = 0.0
        self._later_seconds = 0.0
        self._origin: int | None = None  # tick of the run's first block
        self._elapsed_before = 0.0  # [s] until a lost device was reconnected

    # Progress

    @property
    def machine(self) -> StateMachine:
        """The state of the run."""
        return self.inputs.machine

    @property
    def interrupted(self) -> bool:
        """Whether a person asked for a pause, or to skip the step."""
        return self.inputs.control.requests.pause or self.inputs.control.requests.skip

    @property
    def elapsed(self) -> float:
        """Device time [s] since the run's first block."""
        if self._origin is None:
            self._origin = self.session.now or None
        return self._elapsed_before + (self.session.now - (self._origin or 0)) / self.session.rate

    def begin(self, part: PlannedStep, rest: Sequence[PlannedStep]) -> None:
        """Begin a step of the plan's sequence; `rest` are those after it."""
        self._part, self._part_began = part, self.elapsed
        self._later_seconds = sum(after.seconds for after in rest)
        self.bench.status(part=self._parts - len(rest))

    def remaining_seconds(self) -> float:
        """Return the expected remaining time [s]; conditions count with their least time."""
        if self._part is None:
            return self._later_seconds
        remaining = self._part.seconds - (self.elapsed - self._part_began)
        return self._later_seconds + max(0.0, remaining)

    def report_phase(self, step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
        """Report a phase and the expected end of the run."""
        self.bench.status(total_s=self.elapsed + self.remaining_seconds())
        self._on_phase(step, phase, repeat, repeats, message)

    def note_state(self, before: EngineState, after: EngineState, why: str) -> None:
        """Write a change of state to the run's log and publish it."""
        self.bench.event("state", self.bench.tick, before=str(before), state=str(after), why=why)
        self.bench.status(engine=str(after))

    # Actions of steps

    def do(self, planned: PlannedStep) -> None:
        """Run one step, after a pause if a person has requested one."""
        self._safe_point()
        if self._skipped(planned.name):
            return
        if not planned.excitations:
            self.report_phase(planned.name, planned.step.key.replace("_", " "), 0, 0, planned.title)
        planned.step.run(planned, self)
        self._skipped(planned.name)

    def excite(self, planned: PlannedStep) -> None:
        """Take the records of an excitation, again from its positioning after every pause."""
        (step,) = planned.excitations
        before = self._at_begin.setdefault(step.name, self._complete.get(step.name, 0))
        swept = planned.step.parameters if isinstance(planned.step, Step) else {}
        running = ExcitationRun(self.session, self._place, step, self, before + 1, swept)
        running.taken = self._complete.get(step.name, 0) - before  # after a lost device
        complete = running.taken >= step.repeats
        while not complete:
            try:
                complete = running.run()
            finally:
                self.records += before + running.taken - self._complete.get(step.name, 0)
                self._complete[step.name] = before + running.taken
                if running.taken:
                    self._last_record = f"{step.name}_r{before + running.taken}"
            if complete or self._skipped(step.name):
                break
            self._safe_point()
            if self._skipped(step.name):
                break
        self._at_begin.pop(step.name, None)

    def excite_until(self, planned: PlannedStep, condition: Condition | None, most: float) -> bool:
        """Excite without records until a condition holds; False after `most` seconds."""
        (step,) = planned.excitations
        done = self._judge(condition)
        self.session.wait(ENGINE.look_seconds)
        remaining = most
        while not done():
            began = self.elapsed
            if remaining <= 0.0:
                return False
            running = ExcitationRun(self.session, self._place, step, self)
            reached = running.move_until(done, remaining)
            remaining -= self.elapsed - began
            if reached or self._skipped(step.name):
                return True
            if self.interrupted:
                self._safe_point()
        return True

    def hold(self, planned: PlannedStep, locks: Sequence[LockPlan], seconds: float) -> None:
        """Bring joints to their places, close every valve, and record the time."""
        self.machine.to(EngineState.HOMING, planned.title)
        self.session.bench.guard([FREE] * self.session.joints)
        self.session.wait(ENGINE.look_seconds)
        if locks:
            targets = {part.joint: part.piston for part in locks}
            self.report_phase(planned.name, "place", 0, 0, planned.title)
            move(
                self.session, targets, self._place, self._place.tolerance,
                ENGINE.settle_seconds, planned.name
            )  # fmt: skip
        self.machine.to(EngineState.LOCKED, "valves closed")
        self.session.off()
        if planned.step.name is None:
            self._wait_at_rest(seconds)
        else:
            self._record_at_rest(planned, seconds)
        self.rest_now(f"{planned.name} is over")

    def _record_at_rest(self, planned: PlannedStep, seconds: float) -> None:
        name = planned.name
        repeat = self._complete.get(name, 0) + 1
        joints = tuple(range(1, self.session.joints + 1))
        ticks = round(seconds * self.session.rate)
        meta = RecordMeta(step=name, repeat=repeat, locked=joints, attributes={"excited": ""})
        self.report_phase(name, "record", repeat, repeat, f"{seconds:g} s with every valve closed")
        first = self.session.now
        with self.bench.record(meta, start_tick=first, ticks=ticks) as record:
            self.session.until(first + ticks)
            span = min(round(ENGINE.look_seconds * self.session.rate), ticks // 2)
            for j in range(self.session.joints):
                began = placement(self.session, j, first, first + span).piston
                ended = placement(self.session, j, first + ticks - span, first + ticks).piston
                record.note(**{f"creep_m_{j + 1}": ended - began})
        self._complete[name] = repeat
        self.records += 1

    def lock(self, planned: PlannedStep, locks: Sequence[LockPlan]) -> None:
        """Prove that joints can be locked; the steps that follow lock them again."""
        self.machine.to(EngineState.HOMING, planned.title)
        self.session.bench.guard([FREE] * self.session.joints)
        self.session.wait(ENGINE.look_seconds)
        hold = Hold(planned.name, ENGINE.settle_seconds, 1.0)
        for part in locks:
            self.report_phase(planned.name, "lock", 0, 0, f"joint {part.joint + 1} {part.at}")
            lock(self.session, part, self._place, hold)
            self.machine.to(EngineState.LOCKED, f"joint {part.joint + 1} {part.at}")
        self.rest_now("locks are proved")

    def rest(self, seconds: float, why: str) -> None:
        """Let time pass with all outputs at zero."""
        self.rest_now(why)
        self._wait_at_rest(seconds)

    def wait(self, condition: Condition, most: float) -> bool:
        """Rest until a condition holds; False after `most` seconds."""
        self.rest_now(f"waiting for {condition.text}")
        return self._wait_at_rest(most, self._judge(condition))

    def ask(self, question: Question) -> str:
        """Ask a person, outputs at zero; return the answer, or the default if unattended.

        Raises RunEnded where there is neither.
        """
        self.rest_now("a question")
        control = self.inputs.control
        control.answers, control.requests.answer = question.answers, None
        self.machine.to(EngineState.PROMPTING, question.text)
        self.bench.status(prompt=question.text, answers=list(question.answers))
        choice = f"{question.text} [{'/'.join(question.answers)}]"
        self.report_phase("prompt", "prompt", 0, 0, choice)
        try:
            answer, source = self._answer(question)
        finally:
            control.answers = ()
            self.bench.status(prompt="", answers=[])
        self.bench.event("answer", self.bench.tick, prompt=question.text, answer=answer, by=source)
        self.machine.to(EngineState.IDLE, f"answered {answer!r} ({source})")
        return answer

    def _answer(self, question: Question) -> tuple[str, str]:
        limit = self.inputs.longest_pause if self.inputs.attended else question.timeout
        began = self.elapsed
        while self.elapsed - began < limit:
            self._await_person()
            answer = self.inputs.control.requests.answer
            if answer is not None:
                return answer, "from the screen"
            typed = None if self.inputs.terminal is None else self.inputs.terminal()
            if typed is not None:
                if typed.strip() in question.answers:
                    return typed.strip(), "at the terminal"
                expected = ", ".join(question.answers)
                self.report_phase(
                    "prompt", "prompt", 0, 0, f"{typed.strip()!r} is no answer: {expected}"
                )
        if question.default is None or self.inputs.attended:
            raise RunEnded(f"{question.text!r} was not answered within {limit:g} s")
        return question.default, f"the default, after {limit:g} s"

    def repeat(self, planned: PlannedStep, condition: Condition, rounds: int) -> bool:
        """Run the nested steps until a condition holds; False after `rounds`."""
        for number in range(1, rounds + 1):
            for part in planned.nested:
                self.do(part)
            if condition.estimates:
                self._await_estimates()
            fulfilled = self._judge(condition)()
            verdict = "holds" if fulfilled else "does not hold"
            text = f"{condition.text} {verdict} after round {number}: {self.readings(condition)}"
            self.mark(text)
            self.report_phase(planned.name, "repeat", number, rounds, text)
            if fulfilled:
                return True
        return False

    def _await_estimates(self) -> None:
        """Wait, in wall time, until the parallel estimator has the last record."""
        deadline = time.monotonic() + ENGINE.estimate_seconds
        while not self.inputs.estimates.complete(self._last_record):
            if time.monotonic() > deadline:
                log.warning("the estimator does not keep up; its last estimates count")
                return
            self.session.wait(ENGINE.look_seconds)

    def mark(self, text: str) -> None:
        """Write a line into the run's log."""
        self.bench.event("mark", self.bench.tick, text=text)

    def fail(self, why: str) -> None:
        """Fail the step with a reason."""
        raise ProtocolAborted(why)

    def end(self, why: str) -> None:
        """End the run with a reason."""
        raise RunEnded(why)

    def _await_person(self) -> None:
        """Wait a moment for a person; it is no time of the step, and the rest takes as long."""
        began = self.elapsed
        self.session.wait(ENGINE.look_seconds)
        self._part_began += self.elapsed - began
        self.bench.status(total_s=self.elapsed + self.remaining_seconds())

    # Rest and safe points

    def rest_now(self, why: str, *, confirmed: bool = True) -> None:
        """Zero every output and set the state to idle; unconfirmed where the device is lost."""
        if confirmed:
            self.session.off()
        if self.machine.state not in (EngineState.TRIPPED, EngineState.SAFE):
            self.machine.to(EngineState.IDLE, why)

    def reconnect(self, wait: float) -> None:
        """Reconnect to a lost device and drop the samples read before."""
        self._elapsed_before = self.elapsed
        self.bench.reconnect(wait)
        self.session.forget()
        self._origin = None

    def _obey_requests(self) -> None:
        if self.inputs.control.requests.abort:
            self.bench.zero_outputs()
            raise OperatorStop(self.inputs.control.requests.abort)

    def _safe_point(self) -> None:
        """Pause here if a person requested it; raises RunEnded if nobody resumes."""
        requests = self.inputs.control.requests
        if not requests.pause:
            return
        self.rest_now("a pause was requested")
        requests.pause = requests.resume = False
        self.machine.to(EngineState.PAUSED, "until someone resumes")
        self.report_phase("pause", "paused", 0, 0, "outputs at zero until someone resumes")
        began = self.elapsed
        while not requests.resume and not requests.skip:
            if self.elapsed - began > self.inputs.longest_pause:
                raise RunEnded(
                    f"paused for longer than {self.inputs.longest_pause:g} s; the run is over"
                )
            self._await_person()
        requests.resume = False
        self.machine.to(EngineState.IDLE, "resumed; joints are positioned and locked again")

    def _skipped(self, name: str) -> bool:
        requests = self.inputs.control.requests
        if not requests.skip:
            return False
        requests.skip = False
        self.rest_now(f"{name} is skipped")
        self.mark(f"{name} was skipped by a person")
        self.report_phase(name, "skip", 0, 0, "skipped by a person")
        return True

    def _wait_at_rest(self, seconds: float, done: Callable[[], bool] | None = None) -> bool:
        """Wait at rest; return True when `done`, or a person wants to continue; else False."""
        began = self.elapsed
        self.session.wait(min(ENGINE.look_seconds, seconds))
        while done is None or not done():
            if self.inputs.control.requests.skip:
                return True
            if self.inputs.control.requests.pause and self.machine.state is EngineState.IDLE:
                self._safe_point()
            remaining = seconds - (self.elapsed - began)
            if remaining <= 0.5 / self.session.rate:
                return False
            self.session.wait(min(ENGINE.look_seconds, remaining))
        return True

    def _judge(self, condition: Condition | None) -> Callable[[], bool]:
        """Return a function that evaluates a condition; `elapsed` counts from this call."""
        began = self.elapsed

        def holds() -> bool:
            return condition is None or condition.holds(self._values(condition, began))

        return holds

    def readings(self, condition: Condition) -> str:
        """Return the present values of a condition's names, with units."""
        return condition.readings(self._values(condition, self.elapsed))

    def _values(self, condition: Condition, began: float) -> Mapping[str, float]:
        values: dict[str, float] = {**self.inputs.estimates.values(), ELAPSED: self.elapsed - began}
        first = max(0, self.session.now - round(ENGINE.look_seconds * self.session.rate))
        for name in condition.names:
            if name in self.session.rig.recorded:
                samples = self.session.channel(name, first, self.session.now)
                finite = samples[np.isfinite(samples)]
                values[name] = float(np.mean(finite)) if len(finite) else math.nan
        return values
