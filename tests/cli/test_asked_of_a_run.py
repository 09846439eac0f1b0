"""What a person asks of a run over its local socket, and what a lost device makes of it."""

from __future__ import annotations

import itertools
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from protocols.engine.states import TRANSITIONS, EngineState
from rig.bench.screens.commands import Command
from rig.bench.screens.sockets import Attachment
from rig.cli.errors import alarm
from rig.cli.execution.protocol_run import terminal_lines
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.cli.bench import (
    LONG,
    SHORT,
    bramah,
    bramah_here,
    outputs_are_zero,
    simulated,
    started,
    wait_for,
)
from tests.cli.test_lab_sheet import states, stream

RIG = "shinshu-2dof"
TWO = SHORT.replace("repeats: 2", "repeats: 400").replace("name: short", "name: two") + (
    "  - pause: 5 min\n  - prompt: Is it still quiet?\n    timeout: 10 min\n  - mark: the end\n"
)
REST = "rest 300 s, outputs at zero"
OPERATOR = "operator at desk 1"


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    # A socket's address holds about 100 bytes: the usual temporary folder of a test is too deep.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


class Desk:
    """A person at a screen of the run in `folder`, done by `process`."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self.process = process
        self.folder = folder
        self._screen = Attachment(self._endpoint())

    def _endpoint(self) -> Any:
        deadline = time.monotonic() + LONG
        while time.monotonic() < deadline:
            for endpoint in Attachment.find(RIG):
                if endpoint.pid == self.process.pid:
                    return endpoint
            assert self.process.poll() is None, self.process.communicate()[1]
            time.sleep(0.02)
        raise AssertionError("the run opened no socket")

    def ask(self, word: str, value: str = "", holder: str = OPERATOR) -> str | None:
        """Ask; None where it is taken, else why not."""
        return self._screen.ask(Command(word, value, holder), timeout=LONG)

    def until(self, holds: Callable[[list[dict[str, Any]]], bool], what: str) -> None:
        """Wait until the events of the run say something."""
        deadline = time.monotonic() + LONG
        while not holds(read_events(self.folder)):
            assert time.monotonic() < deadline, what
            assert self.process.poll() is None, (what, self.process.communicate()[1])
            time.sleep(0.02)

    def until_state(self, state: EngineState) -> None:
        """Wait until the run is in a state."""
        self.until(lambda events: [s for s, _ in states(events)][-1:] == [state], str(state))

    def close(self) -> None:
        """Leave."""
        self._screen.close()


def test_pause_resume_skip_answer_and_abort_on_a_run_of_another_process(tmp_path: Path) -> None:
    (tmp_path / "two.yaml").write_text(TWO)
    run = tmp_path / "run"
    with simulated("--seed", 3) as (endpoint, _):
        line = ("run", tmp_path / "two.yaml", "--rig", RIG, "--out", run, "--endpoint", endpoint)
        with started(*line, "--unattended") as process:
            desk = Desk(process, run)
            wait_for("record 2 of", process)
            assert desk.ask("resume") == "the run is not paused but exciting"
            assert "nothing is asked now" in str(desk.ask("answer", "yes"))
            assert desk.ask("pause") is None
            assert "operator at desk 1 is in control" in str(
                desk.ask("skip", holder="somebody else")
            )
            desk.until_state(EngineState.PAUSED)
            assert "paused already" in str(desk.ask("pause"))
            assert desk.ask("resume") is None
            desk.until_state(EngineState.EXCITING)
            assert desk.ask("skip") is None  # the step with its 400 records
            desk.until(lambda events: any(e.get("message") == REST for e in events), "the rest")
            assert desk.ask("skip") is None  # five minutes of rest
            desk.until_state(EngineState.PROMPTING)
            assert "expected one of: yes, no" in str(desk.ask("answer", "perhaps"))
            assert desk.ask("answer", "yes") is None
            _, said = process.communicate(timeout=LONG)
            desk.close()
        assert process.returncode == 0, said
        assert outputs_are_zero(endpoint)
    events = read_events(run)
    seen = [state for state, _ in states(events)]
    for before, after in itertools.pairwise([EngineState.IDLE, *seen]):
        assert after in TRANSITIONS[before]
    paused = seen.index(EngineState.PAUSED)
    # From a pause back to motion only through places and locks.
    assert seen[paused + 1 : paused + 5] == [
        EngineState.IDLE, EngineState.HOMING, EngineState.LOCKED, EngineState.EXCITING,
    ]  # fmt: skip
    assert seen[-2:] == [EngineState.IDLE, EngineState.SAFE]
    times = states(events)
    begins, ends = times[paused][1], times[paused + 1][1]
    for joint in (1, 2):
        span = slice(round(1000 * begins) + 20, round(1000 * ends))
        assert not stream(run, f"command_{joint}")[span].any()
    skips = [e["text"] for e in events if e["event"] == "mark" and "skipped" in e["text"]]
    assert skips == ["step1 was skipped by a person", "pause was skipped by a person"]
    (answer,) = [e for e in events if e["event"] == "answer"]
    assert (answer["answer"], answer["by"]) == ("yes", "from the screen")
    found = load_run(run)
    assert found.state == "done"
    assert [r.repeat for r in found.records] == list(range(1, len(found.records) + 1))
    assert all(r.attributes["complete"] for r in found.records)


def test_an_abort_from_the_screen_is_a_stop_that_keeps_the_records(tmp_path: Path) -> None:
    (tmp_path / "two.yaml").write_text(TWO)
    run = tmp_path / "run"
    with simulated("--seed", 3) as (endpoint, _):
        line = ("run", tmp_path / "two.yaml", "--rig", RIG, "--out", run, "--endpoint", endpoint)
        with started(*line) as process:
            desk = Desk(process, run)
            wait_for("record 3 of", process)
            assert desk.ask("abort") is None
            _, said = process.communicate(timeout=LONG)
            desk.close()
        assert process.returncode == 130, said
        assert said.strip().splitlines()[-1].startswith(f"bramah: aborted by {OPERATOR}")
        assert outputs_are_zero(endpoint)
    assert (run / "state").read_text() == "aborted\n"
    assert len(load_run(run).records) >= 2
    assert [state for state, _ in states(read_events(run))][-1] is EngineState.SAFE


@pytest.mark.slow
def test_a_question_that_nobody_answers_ends_an_unattended_run(tmp_path: Path) -> None:
    sheet = "name: quiz\njoints: 2\nsteps:\n  - prompt: Is it warm?\n    timeout: 20 s\n"
    (tmp_path / "quiz.yaml").write_text(sheet)
    run = tmp_path / "run"
    with simulated() as (endpoint, _):
        done = bramah(
            "run", tmp_path / "quiz.yaml", "--rig", RIG, "--out", run, "--endpoint", endpoint
        )
        assert outputs_are_zero(endpoint)
    assert done.returncode == 1
    assert "'Is it warm?' was not answered within 20 s" in done.stderr.splitlines()[-1]
    assert (run / "state").read_text() == "aborted\n"
    assert not stream(run, "command_1").any()


@pytest.mark.slow
def test_a_condition_that_never_comes_ends_the_run_with_what_was_waited_for(
    tmp_path: Path,
) -> None:
    sheet = "name: cold\njoints: 2\nsteps:\n  - wait_until: oil_temperature > 90 degC\n"
    (tmp_path / "cold.yaml").write_text(sheet + "    timeout: 20 s\n")
    run = tmp_path / "run"
    with simulated() as (endpoint, _):
        done = bramah(
            "run", tmp_path / "cold.yaml", "--rig", RIG, "--out", run, "--endpoint", endpoint
        )
    assert done.returncode == 1
    assert "oil_temperature > 90 degC" in done.stderr.splitlines()[-1]
    assert "20 s" in done.stderr.splitlines()[-1]
    assert len(stream(run, "oil_temperature")) >= 20_000


def rebooting(folder: Path, *seconds: int) -> Path:
    """A scenario in which the device starts anew at these times of its clock."""
    faults = ", ".join(f"{{name: reboots, at: {at} s}}" for at in seconds)
    path = folder / "reboots.yaml"
    path.write_text(f"faults: [{faults}]\n")
    return path


def test_a_device_that_comes_back_is_taken_up_where_its_records_ended(tmp_path: Path) -> None:
    sheet = tmp_path / "again.yaml"
    sheet.write_text(SHORT.replace("repeats: 2", "repeats: 6") + "retry: {times: 1, wait: 1 s}\n")
    run = tmp_path / "run"
    with simulated("--seed", 3, "--scenario", rebooting(tmp_path, 20)) as (endpoint, _):
        done = bramah("run", sheet, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        assert done.returncode == 0, done.stderr
        assert outputs_are_zero(endpoint)
    assert "connecting again in 1 s, 0 more allowed" in done.stderr
    events = read_events(run)
    names = [e["event"] for e in events]
    assert names.count("device lost") == names.count("device back") == 1
    assert names.count("stream begins") == 2
    times = [e["t"] for e in events]
    assert times == sorted(times)  # the device counts anew, the run does not
    found = load_run(run, partial=True).records
    whole = [r for r in found if r.attributes["complete"]]
    assert [r.repeat for r in whole] == [1, 2, 3, 4, 5, 6]
    lost = names.index("device lost")
    before = [e for e in events[:lost] if e["event"] == "record complete"]
    assert 0 < len(before) < 6
    # Nothing moves but by way of places and locks.
    after = [s for s, _ in states(events[lost:])]
    assert after[:2] == [EngineState.HOMING, EngineState.LOCKED]


@pytest.mark.slow
def test_a_budget_of_retries_that_is_used_up_ends_the_run_by_name(tmp_path: Path) -> None:
    sheet = tmp_path / "again.yaml"
    sheet.write_text(SHORT.replace("repeats: 2", "repeats: 40") + "retry: {times: 1, wait: 1 s}\n")
    run = tmp_path / "run"
    with simulated("--seed", 3, "--scenario", rebooting(tmp_path, 20, 50)) as (endpoint, _):
        done = bramah("run", sheet, "--rig", RIG, "--out", run, "--endpoint", endpoint)
    assert done.returncode == 4, done.stderr
    assert "Traceback" not in done.stderr
    names = [e["event"] for e in read_events(run)]
    assert names.count("device back") == 1
    assert (run / "state").read_text() == "aborted\n"
    assert load_run(run).records


@pytest.mark.slow
def test_a_device_that_tripped_itself_is_not_taken_up_again(tmp_path: Path) -> None:
    """A cable pulled out trips the device: only a person clears that, whatever the file says."""
    sheet = tmp_path / "again.yaml"
    sheet.write_text(SHORT + "retry: {times: 5, wait: 1 s}\n")
    cable = tmp_path / "cable.yaml"
    cable.write_text("faults: [{name: link_closed, at: 8 s}]\n")
    run = tmp_path / "run"
    with simulated("--seed", 3, "--wire-faults", cable) as (endpoint, _):
        done = bramah("run", sheet, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        assert done.returncode == 3, done.stderr
        assert "the device tripped meanwhile" in done.stderr.splitlines()[-1]
        assert "bramah reset" in done.stderr.splitlines()[-1]
        assert outputs_are_zero(endpoint)
    assert len(stream(run, "piston_2")) > 7000
    names = [e["event"] for e in read_events(run)]
    assert names.count("device lost") == 1
    assert "device back" not in names


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("amplitude",), "--set amplitude: expected NAME=VALUE"),
        (("size=20mm",), "no parameter 'size'; the file has: amplitude frequency rest"),
        (("amplitude=20 kg",), "kg"),
        (("amplitude=20",), "no unit"),
        (("frequency=1 furlongish",), "furlongish"),
        (("rest=5 MPa",), "steps.1.pause: unit 'MPa'"),
        (("amplitude=[1 mm, 2 mm]",), "amplitude"),
        (("amplitude=90 mm",), "sine, joint 2: piston"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_refused_in_one_line(
    settings: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    sheet = tmp_path / "sheet.yaml"
    sheet.write_text(PARAMETERS)
    words = [word for setting in settings for word in ("--set", setting)]
    done = bramah_here("check", sheet, "--rig", RIG, *words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert says in done.stderr


PARAMETERS = """
name: sheet
joints: 2
parameters: {amplitude: 8 mm, frequency: 1 Hz, rest: 5 s}
steps:
  - name: sine
    lock: [{joint: 1, at: closed, tolerance: 4 mm}]
    excite:
      - {joint: 2, signal: {kind: sine, frequency: $frequency, amplitude: $amplitude}}
    duration: 2 s
    repeats: 1
  - pause: $rest
"""


@pytest.mark.slow
def test_a_parameter_in_other_units_is_the_same_and_another_value_another_run(
    tmp_path: Path,
) -> None:
    sheet = tmp_path / "sheet.yaml"
    sheet.write_text(PARAMETERS)

    def checked(*settings: str) -> dict[str, Any]:
        words = [word for setting in settings for word in ("--set", setting)]
        done = bramah("check", sheet, "--rig", RIG, "--json", "-", *words)
        assert done.returncode == 0, done.stderr
        return dict(json.loads(done.stdout))

    def travel(told: dict[str, Any]) -> float:
        lines = told["steps"][0]["predictions"]
        low, high = next(x["predicted"] for x in lines if x["quantity"] == "piston")
        return float(high - low)

    plain = checked()
    same = checked("amplitude=0.8 cm", "rest=5000 ms")
    assert travel(same) == pytest.approx(travel(plain), rel=1e-9)
    assert same["seconds"] == plain["seconds"]
    wider = checked("amplitude=12mm", "rest=65 s")
    assert travel(wider) - travel(plain) == pytest.approx(2 * 4e-3, rel=0.1)
    assert wider["seconds"] == pytest.approx(plain["seconds"] + 60.0)


def test_where_the_shell_has_closed_standard_input_nobody_can_answer(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sys.stdin", None)
    assert terminal_lines(None) is None
    screen = bramah_here("monitor")
    assert screen.returncode == 2
    assert "the screen needs a terminal" in screen.stderr
    loop = bramah_here("loop", "--rig", RIG, "--out", tmp_path / "loop")
    assert loop.returncode == 2
    assert "--unattended" in loop.stderr


def test_an_alarm_has_no_colour_where_standard_error_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stderr", None)
    assert alarm("outputs not confirmed at zero") == "outputs not confirmed at zero"
