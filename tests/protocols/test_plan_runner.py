"""A person pauses, resumes, skips, aborts, answers; a device is lost; nothing moves at rest."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.base import DeviceLost, OutputLaw
from protocols.engine.engine import run
from protocols.engine.run_inputs import RunInputs
from protocols.engine.session import Session
from protocols.engine.states import (
    ENERGISED,
    TRANSITIONS,
    EngineState,
    ProtocolAborted,
    RunEnded,
    StateMachine,
)
from protocols.files.library import read_protocol
from protocols.files.plan import Plan, resolve
from rig.bench.screens.commands import Command, CommandHolder
from rig.model.rig import Rig
from rig.model.trips import OperatorStop
from rig.runs.rigs import load_rig
from tests.protocols.little_bench import LittleBench, default_cylinders

STEP = """\
  - name: NAME
    lock: [{joint: 1, at: closed}]
    excite: [{joint: 2, signal: {kind: sine, frequency: 1 Hz, amplitude: 0.4 V}}]
    repeats: 3
    duration: 3 s
    ramp: 1 s
"""
HEAD = "name: sheet\njoints: 2\n"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


class Attended:
    """A run on the little bench, and what a person does at its phases."""

    def __init__(self, rig: Rig, body: str, **inputs: object) -> None:
        self.rig = rig
        self.plan: Plan = resolve(read_protocol(HEAD + body, "sheet.yaml"), rig)
        self.bench = LittleBench(rig, default_cylinders())
        self.inputs = RunInputs(**inputs)  # type: ignore[arg-type]
        self.phases: list[tuple[str, str, int]] = []
        self.acts: dict[tuple[str, int], Callable[[], None]] = {}

    def on(self, phase: str, repeat: int, act: Callable[[], None]) -> None:
        self.acts[phase, repeat] = act

    def says(self, word: str, value: str = "") -> str | None:
        return self.inputs.control.accept(Command(word, value, "a person", 1))

    def run(self) -> None:
        def phase(step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
            self.phases.append((step, phase, repeat))
            act = self.acts.pop((phase, repeat), None)
            if act is not None:
                act()

        run(self.plan, self.rig, self.bench, phase, self.inputs)

    @property
    def states(self) -> list[str]:
        return [e["state"] for e in self.bench.events if e["event"] == "state"]

    def marks(self) -> list[str]:
        return [e["text"] for e in self.bench.events if e["event"] == "mark"]

    def at_rest(self) -> bool:
        return all(law.limit == 0.0 for law in self.bench.laws)


def test_every_run_ends_safe_and_only_homing_leads_from_rest_to_motion(rig: Rig) -> None:
    sheet = Attended(rig, "steps:\n" + STEP.replace("NAME", "one"))
    sheet.run()
    assert sheet.states == ["homing", "locked", "exciting", "idle", "safe"]
    assert sheet.at_rest()
    starts = {
        state for state, ways in TRANSITIONS.items() if ways & ENERGISED and state not in ENERGISED
    }
    assert starts == {EngineState.IDLE}
    assert TRANSITIONS[EngineState.IDLE] & ENERGISED == {EngineState.HOMING}


def test_a_session_at_rest_refuses_every_law(rig: Rig) -> None:
    machine = StateMachine()
    session = Session(LittleBench(rig, default_cylinders()), rig, 100, machine, lambda: None)
    for state in set(EngineState) - ENERGISED:
        machine._state = state
        with pytest.raises(RuntimeError, match=f"in state {state}"):
            session.apply({0: OutputLaw(bias=0.1, limit=1.0)})
        session.apply({0: OutputLaw()})


def test_a_pause_comes_after_the_record_and_resuming_begins_with_the_place(rig: Rig) -> None:
    sheet = Attended(rig, "steps:\n" + STEP.replace("NAME", "one"))
    seen: list[bool] = []

    def resume() -> None:
        seen.append(sheet.at_rest())
        assert sheet.says("resume") is None

    sheet.on("record", 2, lambda: seen.append(sheet.says("pause") is None))
    sheet.on("paused", 0, resume)
    sheet.run()
    assert seen == [True, True]
    assert [r.meta.name for r in sheet.bench.complete] == ["one_r1", "one_r2", "one_r3"]
    told = [phase for _, phase, _ in sheet.phases]
    assert told.index("paused") < len(told) - 1
    assert told[told.index("paused") + 1] == "place"


def test_a_pause_that_nobody_ends_ends_the_run_at_rest(rig: Rig) -> None:
    sheet = Attended(rig, "steps:\n" + STEP.replace("NAME", "one"), longest_pause=30.0)
    sheet.on("record", 1, lambda: sheet.says("pause"))
    with pytest.raises(RunEnded, match="paused for longer than 30 s"):
        sheet.run()
    assert sheet.states[-2:] == ["paused", "safe"]
    assert sheet.at_rest()
    assert "over" in (sheet.says("resume") or "")


def test_a_resume_without_a_pause_and_an_answer_without_a_question_are_refused(rig: Rig) -> None:
    sheet = Attended(rig, "steps:\n" + STEP.replace("NAME", "one"))
    heard: list[str | None] = []
    sheet.on("record", 1, lambda: heard.extend([sheet.says("resume"), sheet.says("answer", "x")]))
    sheet.run()
    assert heard == [
        "the run is not paused but exciting",
        "nothing is asked now; the run is exciting",
    ]


def test_a_step_is_skipped_after_its_record(rig: Rig) -> None:
    body = "steps:\n" + STEP.replace("NAME", "one") + STEP.replace("NAME", "two")
    sheet = Attended(rig, body)
    sheet.on("record", 1, lambda: sheet.says("skip"))
    sheet.run()
    assert [r.meta.name for r in sheet.bench.complete] == ["one_r1", "two_r1", "two_r2", "two_r3"]
    assert sheet.marks() == ["one was skipped by a person"]


def test_an_abort_does_not_wait_for_the_record(rig: Rig) -> None:
    sheet = Attended(rig, "steps:\n" + STEP.replace("NAME", "one"))
    sheet.on("record", 2, lambda: sheet.says("abort"))
    with pytest.raises(OperatorStop, match="aborted by a person"):
        sheet.run()
    assert [r.state for r in sheet.bench.records] == ["complete", "partial"]
    assert sheet.states[-1] == "safe"


ASK = "steps:\n  - prompt: Go?\n    default: DEFAULT\n    timeout: 20 s\n  - mark: gone\n"


def test_nobody_answers_and_the_default_counts_after_its_time(rig: Rig) -> None:
    sheet = Attended(rig, ASK.replace("DEFAULT", "yes"))
    sheet.run()
    assert sheet.marks() == ["gone"]
    assert sheet.bench.tick >= 20_000
    assert sheet.states == ["prompting", "idle", "safe"]


def test_the_time_left_stands_while_a_person_is_awaited(rig: Rig) -> None:
    sheet = Attended(rig, ASK.replace("DEFAULT", "yes") + STEP.replace("NAME", "one"))
    left: list[float] = []

    def look() -> None:
        left.append(sheet.bench.shown["total_s"] - sheet.bench.tick / rig.sample_rate)

    for tick in (5_000, 12_000, 19_000):
        sheet.bench.happenings[tick] = look
    sheet.run()
    assert left[0] > 10.0
    assert left == pytest.approx([left[0]] * 3, abs=0.3)


def test_a_question_without_a_default_that_nobody_answers_ends_the_run(rig: Rig) -> None:
    sheet = Attended(rig, ASK.replace("    default: DEFAULT\n", ""))
    with pytest.raises(RunEnded, match="'Go\\?' was not answered within 20 s"):
        sheet.run()
    assert sheet.states[-1] == "safe"


@pytest.mark.parametrize("way", ["screen", "terminal"])
def test_a_person_answers_and_a_wrong_word_is_none(rig: Rig, way: str) -> None:
    typed = iter([None, "perhaps", "no"])
    terminal = (lambda: next(typed, None)) if way == "terminal" else None
    sheet = Attended(rig, ASK.replace("DEFAULT", "yes"), terminal=terminal)
    heard: list[str | None] = []
    if way == "screen":
        sheet.bench.happenings[500] = lambda: heard.append(sheet.says("answer", "perhaps"))
        sheet.bench.happenings[900] = lambda: heard.append(sheet.says("answer", "no"))
    with pytest.raises(RunEnded, match="'Go\\?' was answered 'no'"):
        sheet.run()
    assert sheet.marks() == []
    assert way == "terminal" or heard == ["'perhaps' is no answer; expected one of: yes, no", None]


def test_a_condition_that_never_comes_ends_the_run_or_is_skipped(rig: Rig) -> None:
    wait = "steps:\n  - wait_until: piston_1 > 20 mm\n    timeout: 3 s\n  - mark: after\n"
    sheet = Attended(rig, wait)
    with pytest.raises(ProtocolAborted, match=r"not come within 3 s: piston_1 -?[0-9.e-]+ mm"):
        sheet.run()
    again = Attended(rig, "on_error: {then: skip}\n" + wait)
    again.run()
    assert again.marks()[-1] == "after"
    assert again.states[-1] == "safe"


def test_a_repetition_ends_when_the_estimate_is_good_enough(rig: Rig) -> None:
    class Estimator:
        seen = 0

        def values(self) -> dict[str, float]:
            return {"b.rsd": 0.02 / max(1, self.seen)}

        def complete(self, record: str) -> bool:
            self.seen = int(record.rsplit("_r", 1)[1])
            return True

    inner = STEP.replace("NAME", "one").replace("repeats: 3", "repeats: 2")
    inner = "".join(f"    {line}\n" for line in inner.splitlines())
    body = "steps:\n  - repeat_until: b.rsd < 0.6 %\n    at_most: 5\n    steps:\n" + inner
    sheet = Attended(rig, body, estimates=Estimator())
    sheet.run()
    names = [r.meta.name for r in sheet.bench.complete]
    assert names == ["one_r1", "one_r2", "one_r3", "one_r4"]
    assert sheet.marks()[-1] == "b.rsd < 0.6 % holds after round 2: b.rsd 0.5 %"


@pytest.mark.parametrize("losses", [2, 3])
def test_only_a_lost_device_is_tried_again_within_its_budget(rig: Rig, losses: int) -> None:
    body = "retry: {times: 2, wait: 1 s}\nsteps:\n" + STEP.replace("NAME", "one")
    sheet = Attended(rig, body)

    def lose() -> None:
        raise DeviceLost("the wire is silent")

    for number in range(losses):
        sheet.on("record", 1 + number, lose)
    if losses == 3:
        with pytest.raises(DeviceLost):
            sheet.run()
    else:
        sheet.run()
        assert [r.meta.name for r in sheet.bench.complete] == ["one_r1", "one_r2", "one_r3"]
    assert sheet.bench.reconnected == 2


@pytest.mark.parametrize("attempts", [1, 2])
def test_a_device_that_restarts_slowly_is_asked_again_as_often_as_allowed(
    rig: Rig, attempts: int
) -> None:
    """The first attempt finds no device; a second one does, where the protocol allows two."""
    body = f"retry: {{times: {attempts}, wait: 1 s}}\nsteps:\n" + STEP.replace("NAME", "one")
    sheet = Attended(rig, body)

    def lose() -> None:
        raise DeviceLost("the wire is silent")

    sheet.on("record", 1, lose)
    sheet.bench.unreachable = 1
    if attempts == 1:
        with pytest.raises(DeviceLost, match="connection refused"):
            sheet.run()
    else:
        sheet.run()
        assert [r.meta.name for r in sheet.bench.complete] == ["one_r1", "one_r2", "one_r3"]
    assert sheet.bench.reconnected == attempts


def test_a_hold_records_the_creep_with_every_valve_closed(rig: Rig) -> None:
    body = (
        "steps:\n  - hold: 5 s\n    name: still\n    lock: [{joint: 1, at: closed, piston: 5 mm}]\n"
    )
    sheet = Attended(rig, body)
    sheet.bench.cylinders[0].load = 2e-4
    sheet.run()
    (record,) = sheet.bench.complete
    assert (record.ticks, record.meta.locked) == (5000, (1, 2))
    assert record.attributes["creep_m_1"] == pytest.approx(2e-4 * 4.9, rel=0.1)
    assert abs(sheet.bench.channel("command_1", record.start + 20, record.ticks - 20)).max() == 0.0


def test_one_screen_holds_the_controls_and_anyone_may_stop() -> None:
    holder = CommandHolder()
    first, second = Command("pause", holder="first"), Command("resume", holder="second")
    assert holder.judge(first, lambda _: None) is None
    refused = holder.judge(second, lambda _: None)
    assert refused == "first is in control; take control, or wait for its release"
    assert holder.judge(Command("stop"), lambda _: "never") is None
    assert holder.judge(Command("release", holder="first"), None) is None
    assert holder.judge(second, lambda _: "not now") == "not now"
