"""A person lets the loop run: what one experiment cannot show the next one does, or it says why."""

from __future__ import annotations

import functools
import json
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from analysis.report.loop import render
from analysis.simulation.model import load_model
from analysis.simulation.twin import simulate_commands
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from analysis.trace.loop_rounds import Round, rounds_json
from protocols.design.check import check
from protocols.files import library
from protocols.files.plan import resolve
from rig.cli.execution import experiment_loop
from rig.cli.execution.experiment_loop import (
    DECLINED,
    FLOOR,
    NOTHING,
    REFUSED,
    ROUNDS,
    Loop,
    LoopRequest,
)
from rig.cli.simulated import simulated_bench
from rig.cli.text.trace_text import rounds_text
from rig.runs.rigs import load_rig
from tests.analysis.page import Page
from tests.cli.bench import bramah, bramah_here
from tests.cli.loops import SINE, WAVES, Inside, looped

RIG = "shinshu-2dof"
FEW = ("coulomb_friction", "dead_volume", "entrained_air", "internal_leakage", "tank_pressure")


@pytest.fixture(scope="module")
def air(tmp_path_factory: pytest.TempPathFactory) -> Inside:
    """A bench with 1 % of air in its oil, first moved by a sine; few candidates, to be quick."""
    few = functools.partial(trace, effects=catalogue(load_rig(RIG), FEW))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment_loop, "trace", few)
        return looped(
            tmp_path_factory.mktemp("air"), SINE, "{name: entrained_air, fraction: 1 %}",
            until_visible=True,
        )  # fmt: skip


def test_air_that_a_sine_cannot_show_is_brought_to_light_and_named(air: Inside) -> None:
    first, second = air.rounds
    assert first.result.verdict == "clean"
    assert second.experiment is not None
    assert {"name": "entrained_air", "where": "bench"} in second.experiment["separates"]
    assert second.result.verdict == "explained"
    (found,) = second.result.effects
    assert (found.name, found.where) == ("entrained_air", "bench")
    assert found.parameters["alpha_air"].value == pytest.approx(0.01, rel=0.1)
    assert second.residual < 1.3
    assert air.stopped == FLOOR


def test_an_experiment_brings_about_what_it_promised(air: Inside) -> None:
    second = air.rounds[1]
    assert second.experiment is not None
    assert second.predicted is not None
    assert second.achieved is not None
    assert second.predicted > max(0.7, 1.3 * second.experiment["present"])
    assert second.achieved == pytest.approx(second.predicted, rel=0.5)


def test_the_designed_protocol_is_one_that_run_takes_and_the_twin_proves(air: Inside) -> None:
    rig = load_rig(RIG)
    for name in ("next-2.yaml", "judge-2.yaml"):
        plan = resolve(library.load(air.request.out / name), rig)
        assert check(plan, rig, simulate_commands).ok
    train, judge = (library.load(air.request.out / f"{n}-2.yaml") for n in ("next", "judge"))
    assert train.steps[0].excite[0].signal != judge.steps[0].excite[0].signal


def test_the_story_is_told_in_json_in_words_and_on_one_page(air: Inside) -> None:
    told = json.loads(json.dumps(rounds_json(air.rounds, air.stopped), allow_nan=False))
    assert told["verdict"] == "explained"
    assert [r["trace"]["verdict"] for r in told["rounds"]] == ["clean", "explained"]
    assert told["rounds"][1]["runs"] == ["run-2", "holdout-2"]
    text = rounds_text(air.rounds, air.stopped)
    assert f"stopped: {FLOOR}" in text
    page = Page(render(air.train, air.judge, air.rounds, air.stopped))
    for words in ("Round 1: clean", "Round 2: explained", "entrained air", FLOOR):
        assert words in page.text


class Replayed(Loop):
    """A loop whose traces are those of another; nothing is moved."""

    def __init__(self, request: LoopRequest, rounds: Sequence[Round], takes: bool = True) -> None:
        super().__init__(request, lambda line: None)
        self._others, self._takes = list(rounds), takes

    def _record(self, *arguments: object) -> None:
        pass

    def _trace(self, number: int, experiment: object) -> None:
        self.rounds.append(self._others[min(number, len(self._others)) - 1])

    def _passes_check(self, path: Path, sizes: object) -> bool:
        return self._takes


@pytest.mark.parametrize(
    ("changes", "takes", "why", "count"),
    [
        ({"until_visible": False}, True, FLOOR, 1),
        ({"ask": lambda experiment: False}, True, DECLINED, 1),
        ({"rounds": 0}, True, ROUNDS, 1),
        ({"rounds": 2}, True, ROUNDS, 3),
        ({}, False, REFUSED, 1),
    ],
)
def test_it_stops_where_it_should_and_says_why(
    air: Inside, tmp_path: Path, changes: dict[str, object], takes: bool, why: str, count: int
) -> None:
    request = LoopRequest(RIG, tmp_path, **({"until_visible": True, **changes}))  # type: ignore[arg-type]
    experiments = Replayed(request, air.rounds[:1], takes)
    experiments.run()
    assert experiments.stopped == why
    assert len(experiments.rounds) == count


class Repeated(Replayed):
    """A loop as the command runs it, whose records and traces are those of `made`."""

    made: Inside

    def __init__(self, request: LoopRequest, say: object) -> None:
        super().__init__(request, self.made.rounds)
        self.train, self.judge = self.made.train, self.made.judge


def of_a_killed_loop(out: Path) -> tuple[dict[str, Any], str]:
    """What a loop that got SIGKILL now would leave: its JSON and the text of its page."""
    assert load_model(out / "model.json").rig.name == RIG
    assert not list(out.glob(".*"))
    return json.loads((out / "loop.json").read_text()), Page((out / "loop.html").read_text()).text


def test_each_round_is_on_the_disk_when_the_next_begins(
    air: Inside, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    class Looked(Repeated):
        made = air

        def _record(self, number: int, *_: object) -> None:
            if number > 1:
                seen.append(of_a_killed_loop(self.request.out))

    monkeypatch.setattr(experiment_loop, "Loop", Looked)
    done = bramah_here("loop", "--rig", RIG, "--out", tmp_path, "--unattended", "--until-visible")
    assert done.returncode == 0, done.stderr
    ((told, page),) = seen
    assert [r["round"] for r in told["rounds"]] == [1]
    assert told["stopped"] == ""
    assert "had not ended when this page was written, after round 1" in page
    told, page = of_a_killed_loop(tmp_path)
    assert [r["round"] for r in told["rounds"]] == [1, 2]
    assert told["stopped"] == FLOOR
    assert f"Stopped: {FLOOR}" in page


def signalled(made_by: Inside, number: signal.Signals) -> type[Repeated]:
    """A loop that gets a signal while it traces its second round."""

    class Signalled(Repeated):
        made = made_by

        def _trace(self, round_: int, experiment: object) -> None:
            if round_ == 2:
                signal.raise_signal(number)
            super()._trace(round_, experiment)

    return Signalled


@contextmanager
def hang_up(action: signal.Handlers) -> Iterator[None]:
    """What SIGHUP does to a process that is started now, whatever it does to these tests."""
    before = signal.signal(signal.SIGHUP, action)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_loop_under_nohup_outlives_its_terminal(
    air: Inside, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment_loop, "Loop", signalled(air, signal.SIGHUP))
    line = ("loop", "--rig", RIG, "--out", tmp_path, "--unattended", "--until-visible")
    with hang_up(signal.SIG_IGN):
        assert bramah_here(*line).returncode == 0


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_a_terminal_closed_while_a_round_is_traced_ends_the_loop_as_ctrl_c_does(
    air: Inside, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setattr(experiment_loop, "Loop", signalled(air, number))
    line = ("loop", "--rig", RIG, "--out", tmp_path, "--unattended", "--until-visible")
    with hang_up(signal.SIG_DFL):
        done = bramah_here(*line)
    assert done.returncode == 130
    assert done.stderr.splitlines()[-1] == "bramah: stopped"
    told, page = of_a_killed_loop(tmp_path)
    assert [r["round"] for r in told["rounds"]] == [1]
    assert told["stopped"] == "stopped"
    assert "Stopped: stopped" in page


@pytest.mark.parametrize("simulate", [False, True])
def test_the_model_becomes_the_twins_unless_the_bench_ended_with_the_loop(
    air: Inside, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, simulate: bool
) -> None:
    class Made(Repeated):
        made = air

    monkeypatch.setattr(experiment_loop, "Loop", Made)
    monkeypatch.setattr(simulated_bench, "simulated_bench", lambda *_, **__: nullcontext("here"))
    more = ["--simulate"] if simulate else []
    line = ("loop", "--rig", RIG, "--out", tmp_path, "--unattended", "--until-visible", *more)
    done = bramah_here(*line)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "model.json").is_file()
    assert ("check and run" in done.stderr) == (not simulate)


@pytest.mark.slow
def test_a_leak_is_traced_over_the_wire_into_folders_of_its_own(tmp_path: Path) -> None:
    protocol, out = tmp_path / "waves.yaml", tmp_path / "monday"
    protocol.write_text(WAVES)
    done = bramah(
        "loop", "--rig", RIG, "--out", out, "--protocol", protocol, "--unattended", "--simulate",
        "--scenario", "worn-seal", "--seed", 3,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads((out / "loop.json").read_text())
    assert told["verdict"] == "explained"
    assert [(e["name"], e["where"]) for e in told["effects"]] == [("internal_leakage", "joint 2")]
    assert f"stopped: {FLOOR}" in done.stdout
    for part in ("run-1/records.h5", "holdout-1/records.h5", "model.json", "loop.html"):
        assert (out / part).is_file(), part
    again = bramah(
        "loop", "--rig", RIG, "--out", out, "--protocol", protocol, "--unattended", "--simulate"
    )
    assert again.returncode == 2
    assert "run-1 exists already" in again.stderr
    assert "name another folder" in again.stderr


def test_a_trip_ends_the_loop_with_its_code_and_what_was_known(tmp_path: Path) -> None:
    scenario, protocol, out = tmp_path / "bad.yaml", tmp_path / "waves.yaml", tmp_path / "monday"
    scenario.write_text(
        "effects: [{name: sensor_offset, channel: cap_pressure_2, offset: 6 MPa}]\n"
    )
    protocol.write_text(WAVES)
    done = bramah(
        "loop", "--rig", RIG, "--out", out, "--protocol", protocol, "--unattended", "--simulate",
        "--scenario", scenario,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "cap_pressure_2" in done.stderr.strip().splitlines()[-1]
    told = json.loads((out / "loop.json").read_text())
    assert told["rounds"] == []
    assert told["stopped"].startswith("safety trip: limit ")
    assert (out / "run-1" / "state").read_text().strip() == "tripped"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), "--unattended"),
        (("--unattended", "--scenario", "random"), "--simulate"),
        (("--unattended", "--simulate", "--endpoint", "modbus-tcp://127.0.0.1:1"), "--endpoint"),
    ],
)
def test_what_does_not_go_together_is_said(
    more: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    done = bramah_here("loop", "--rig", RIG, "--out", tmp_path / "x", *more)
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("rig", "scenario", "words"),
    [
        ("shinsu-2dof", "worn-seal", "shinsu-2dof"),
        ("emps", "worn-seal", "emps"),
        (RIG, "none.yaml", "none.yaml: no such file"),
        (RIG, "wrong.yaml", "found 'sensor_gian'"),
    ],
)
def test_a_bench_that_cannot_be_simulated_is_bad_input(
    rig: str, scenario: str, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wrong.yaml").write_text("effects: [{name: sensor_gian, gain: 1.01}]")
    line = ("loop", "--rig", rig, "--out", "x", "--unattended", "--simulate")
    done = bramah_here(*line, "--scenario", scenario, cwd=tmp_path)
    assert done.returncode == 2
    assert words in capfd.readouterr().err  # of the bench's process
    assert done.stderr == (
        "bramah: the simulated bench did not start; its error message is above\n"
    )
    assert not (tmp_path / "x").exists()


def test_nothing_to_gain_is_a_reason_to_stop(air: Inside, tmp_path: Path) -> None:
    from dataclasses import replace

    one = air.rounds[0]
    puzzled = replace(one, result=replace(one.result, verdict="unexplained", next_experiment=None))
    experiments = Replayed(LoopRequest(RIG, tmp_path), [puzzled])
    experiments.run()
    assert experiments.stopped == NOTHING
