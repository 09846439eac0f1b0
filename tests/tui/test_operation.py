"""An operator commands a run, acknowledges and resets: what is sent, asked first, and said."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rig.tui import jobs
from tests.tui.glass import Glass, Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, followed, past, run, snapshot, tripped

HERE = endpoint()


def running(**changes: object) -> Recorded:
    record = Recorded(map(followed, run(Bench(), 4.0)))
    record.lately = past(Bench(), 4.0)
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), **changes))
    return record


async def keys(shown: Glass, *names: str) -> None:
    for name in names:
        await shown.press(name)


async def test_the_steps_are_listed_with_the_present_one() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        await shown.press("6")
        assert "✓  1 lock" in shown.text
        assert "▸  2 step1" in shown.text
        assert "now" in next(line for line in shown.lines if "▸  2" in line)
        assert "joint 1 excited, joint 2 locked, 1 record" in shown.text


@pytest.mark.parametrize(
    ("engine", "key", "answer", "asked"),
    [
        ("exciting", "p", (), [("pause", "")]),
        ("paused", "p", ("down", "enter"), [("resume", "")]),
        ("paused", "p", ("enter",), []),
        ("exciting", "n", ("down", "enter"), [("skip", "")]),
        ("exciting", "x", (), [("abort", "")]),  # where it moves nothing is asked first
        ("paused", "x", ("escape",), []),
        ("idle", "x", ("down", "enter"), [("abort", "")]),
    ],
)
async def test_commands_ask_first_where_it_is_safe_to_ask(
    engine: str, key: str, answer: tuple[str, ...], asked: list[tuple[str, str]]
) -> None:
    record = running(engine=engine)
    async with glass(Machine({HERE: record})) as shown:
        await keys(shown, "6", key, *answer)
        if asked:
            await shown.said(asked[0][0])
        assert record.asked == asked
        assert record.commands == []


async def test_a_prompt_is_seen_from_every_page_and_answered_in_the_screen() -> None:
    record = running(engine="prompting", prompt="Load on?", answers=["yes", "no", "stop here"])
    async with glass(Machine({HERE: record})) as shown:
        assert "? PROMPTING" in shown.lines[0]
        await shown.press("4")
        assert "ANSWER: Load on?" in shown.text
        await keys(shown, "a", "down", "down", "enter")
        await shown.said("answer")
        assert record.asked == [("answer", "stop here")]
        assert "'stop here' taken" in shown.text


async def test_a_refusal_is_a_sentence() -> None:
    record = running()
    record.refusal = "a pause is requested already; it comes at the end of the record"
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("p")
        await shown.said("pause")
        assert "pause: a pause is requested already" in shown.text


async def test_two_operators_one_is_in_command_and_the_other_must_take_over() -> None:
    record = running(holder="process 7 on elsewhere")
    async with glass(Machine({HERE: record})) as shown:
        assert "held by another" in shown.lines[0]
        await keys(shown, "6", "p")
        assert "read-only, process 7 on elsewhere is in command" in shown.text
        assert record.asked == []
        await shown.press("t")
        assert "Take the controls?" in shown.text
        await keys(shown, "down", "enter")
        await shown.said("take")
        assert record.asked == [("take", "")]
        mine = replace(followed(snapshot(Bench(), 82)), holder=shown.app.me)
        record.waiting.append(mine)
        await shown.watch(0.1)
        assert "in command" in shown.lines[0]
        await shown.press("t")
        await shown.said("release")
        assert record.asked[-1] == ("release", "")
        record.waiting.append(replace(mine, tick=mine.tick + 1, holder="process 8 on elsewhere"))
        await shown.watch(0.1)
        await shown.press("7")
        assert "in command: process 8 on elsewhere" in shown.text


@pytest.mark.parametrize(("key", "word"), [("t", "take"), ("p", "pause"), ("n", "skip")])
async def test_a_key_that_commands_a_run_says_that_none_is_attached(key: str, word: str) -> None:
    async with glass(Machine({})) as shown:
        await shown.press(key)
        assert shown.app.remark == f"{word}: no run is attached."


async def test_nothing_is_asked_of_a_run_that_is_over() -> None:
    record = running(state="done", engine="safe")
    async with glass(Machine({HERE: record})) as shown:
        for key in ("p", "t", "n", "x"):
            await shown.press(key)
            assert "the run is over (done)" in shown.text
        assert record.asked == []


async def test_a_warning_is_acknowledged_in_the_run() -> None:
    record = running(alarms=followed(snapshot(Bench(), 160)).alarms)
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("5")
        assert "ACTIVE UNACK" in shown.text
        assert "Check pump and relief valve." in shown.text
        await shown.press("k")
        await shown.said("acknowledge")
        assert record.asked == [("acknowledge", "supply pressure: supply_pressure")]


def blinks(shown: Glass) -> int:
    """Count how many looks of the alarm the next second shows."""
    looks = set()
    for _ in range(10):
        shown.clock.now += 0.1
        shown.app.draw()
        looks.add(next(line for line in shown.app.canvas.rows if "UNACK" in str(line)))
    return len(looks)


async def test_only_what_nobody_has_acknowledged_blinks() -> None:
    record = running(alarms=followed(snapshot(Bench(), 160)).alarms)
    async with glass(Machine({HERE: record})) as shown:
        assert blinks(shown) == 2
        last = followed(snapshot(Bench(), 160))
        seen = tuple(replace(alarm, acknowledged=True) for alarm in last.alarms)
        record.waiting.append(replace(last, alarms=seen))
        await shown.watch(0.1)
        assert "UNACK" not in shown.text
        before = shown.app.look.blink
        for _ in range(10):
            shown.clock.now += 0.1
            shown.app.draw()
            assert shown.app.look.blink == before


@pytest.fixture
def tripped_run(tmp_path: Path) -> Machine:
    folder = tmp_path / "run"
    folder.mkdir()
    bench = Bench(spike=7.997, run=str(folder))
    record = Recorded(map(followed, run(bench, 7.95)))
    record.waiting.append(tripped(followed(snapshot(bench, 160))))
    return Machine({HERE: record})


@pytest.fixture
def bramah(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for the command: keeps what it was asked, answers as `reset` does."""
    script = tmp_path / "bramah.py"
    script.write_text(
        "import json, pathlib, sys\n"
        f"pathlib.Path({str(tmp_path / 'asked.json')!r}).write_text(json.dumps(sys.argv[1:]))\n"
        "print('cleared: the trip')\n"
    )
    monkeypatch.setattr(jobs, "BRAMAH", (sys.executable, str(script)))
    return tmp_path / "asked.json"


async def test_after_a_trip_the_first_cause_is_acknowledged_and_then_reset_with_a_reason(
    tripped_run: Machine, bramah: Path, tmp_path: Path
) -> None:
    async with glass(tripped_run, size=(120, 40)) as shown:
        await shown.press("5")
        marked = next(line for line in shown.lines if line.startswith("▸"))
        assert "LATCHED UNACK" in marked
        follows = shown.lines[shown.lines.index(marked) + 1]
        assert "└" in follows
        for part in ("9.31 MPa, allowed −0.2 … 9 MPa", "7.997 s since", "cap_pressure_2 of joint 2",
                     "Check what the load pushes against", "2 s before it"):  # fmt: skip
            assert part in shown.text
        await shown.press("r")
        assert "acknowledge pressure: cap_pressure_2 first" in shown.text
        await shown.press("k")
        assert "■ LATCHED " in shown.text
        assert "■ LATCHED UNACK" not in shown.text
        events = (tmp_path / "run" / "events.jsonl").read_text().splitlines()
        assert json.loads(events[-1])["event"] == "alarm acknowledged"
        await keys(shown, "r", *"hose", "space", *"off", "enter")
        await shown.said("reset: cleared")
        asked = json.loads(bramah.read_text())
        assert asked[:2] == ["reset", "--rig"]
        assert asked[3:] == ["--endpoint", "modbus-tcp://127.0.0.1:5020", "--reason", "hose off"]
        assert "LATCHED" not in shown.text
        assert "▲ ACTIVE UNACK  spool" in shown.text, "what followed still stands"


async def test_a_reset_is_of_the_bench_that_tripped_whatever_runs_when_the_reason_is_given(
    tripped_run: Machine, bramah: Path
) -> None:
    """Another bench's run is attached while the operator types."""
    async with glass(tripped_run) as shown:
        await keys(shown, "5", "k", "r", *"hose")
        frame = shown.app.link.frame
        assert frame.snapshot is not None
        other = replace(frame.snapshot, wire="modbus-tcp://127.0.0.1:6020", run="")
        shown.app.link._frame = replace(frame, snapshot=other)
        await shown.press("enter")
        await shown.said("reset: cleared")
        asked = json.loads(bramah.read_text())
        assert asked[3:] == ["--endpoint", "modbus-tcp://127.0.0.1:5020", "--reason", "hose"]


async def test_a_reset_without_a_reason_resets_nothing(tripped_run: Machine, bramah: Path) -> None:
    async with glass(tripped_run) as shown:
        await keys(shown, "5", "k", "r", "enter")
        assert "a reset needs a reason; nothing was reset" in shown.text
        assert not bramah.exists()


async def test_a_reset_that_fails_says_why_and_the_alarm_stays(
    tripped_run: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = "the device does not answer at this address; is its power on, and what should be done"
    broken = f"import sys; sys.stderr.write('bramah: {said} is at the end\\n'); sys.exit(4)"
    monkeypatch.setattr(jobs, "BRAMAH", (sys.executable, "-c", broken))
    async with glass(tripped_run) as shown:
        await keys(shown, "5", "k", "r", "x", "enter")
        await shown.said("reset: DEVICE LOST: the device does not answer")
        assert "LATCHED" in shown.text
        assert "is at the end" in shown.text


async def test_a_stop_of_a_run_that_has_ended_reaches_its_device(
    tripped_run: Machine, bramah: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run may have ended without confirming that the valve is at zero."""
    tripped_run.runs[HERE].answers = False
    async with glass(tripped_run, size=(160, 40)) as shown:
        await shown.press("space")
        while "OUTPUTS ZEROED: the device confirmed it" not in shown.text:
            await shown.watch()
        asked = json.loads(bramah.read_text())
        assert asked[:2] == ["stop", "--rig"]
        assert asked[3:] == ["--endpoint", "modbus-tcp://127.0.0.1:5020"]
        monkeypatch.setattr(jobs, "BRAMAH", (sys.executable, "-c", "raise SystemExit(4)"))
        await shown.press("space")
        while "Its device: DEVICE LOST" not in shown.text:
            await shown.watch()
        assert "emergency stop" in shown.text


def by_hand(**changes: object) -> Recorded:
    """A manual session, with this screen's view of it."""
    return running(engine="manual", kind="manual", step="manual", part=0, parts=0, **changes)


async def test_a_joint_is_jogged_while_a_key_is_held_and_locked() -> None:
    record = by_hand()
    async with glass(Machine({HERE: record}), size=(120, 40)) as shown:
        await keys(shown, "9", "right")
        assert "joint 2 " in shown.text
        assert "stops when you let go" in shown.text
        for _ in range(30):  # a terminal repeats a held key about 30 times a second
            await shown.press("up")
            shown.clock.now += 0.033
        await shown.said("jog")
        while len(record.asked) < 2:
            await shown.pilot.pause(0.01)
        assert set(record.asked) == {("jog", "2 +")}
        assert len(record.asked) <= 13, "a held key is not sent more often than it has to be"
        del record.asked[:]
        await shown.press("l")
        await shown.said("lock")
        await shown.press("u")
        await shown.said("unlock")
        assert record.asked == [("lock", "2"), ("unlock", "2")]
        record.refusal = "jog: joint 2 is locked; unlock it first"
        shown.clock.now += 1.0
        await shown.press("down")
        await shown.said("jog: joint 2 is locked")
        await shown.press("space")
        await shown.answered()
        assert record.commands == ["stop"]


async def test_the_state_of_a_manual_session_is_readable_on_a_small_terminal() -> None:
    record = by_hand(message="every valve is closed, and joint 1 is held where it stands")
    async with glass(Machine({HERE: record}), size=(60, 16)) as shown:
        await shown.press("9")
        assert "every valve is closed" in shown.text
        assert "held where it stands" in " ".join(shown.text.split())
        assert "let go" in shown.text


async def test_by_hand_is_refused_while_a_protocol_runs() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("9")
        assert "Refused while a protocol runs" in shown.text
        for key in ("up", "down", "l", "u", "d", "enter"):
            await shown.press(key)
            assert shown.app.dialog is None
        assert record.asked == []


async def test_a_manual_session_is_started_after_a_yes(
    bramah: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with glass(Machine(), size=(120, 40)) as shown:
        shown.app.browsed = replace(
            shown.app.browsed, rig="shinshu-2dof", endpoint="modbus-tcp://127.0.0.1:1"
        )
        await keys(shown, "9", "enter")
        assert "Nothing moves until a key is held" in shown.text
        await keys(shown, "down", "enter")
        while not bramah.exists() or not bramah.read_text().endswith("]"):
            await shown.pilot.pause(0.01)
        asked = json.loads(bramah.read_text())
        expected = ["manual", "--rig", "shinshu-2dof", "--endpoint", "modbus-tcp://127.0.0.1:1"]
        assert asked == expected
