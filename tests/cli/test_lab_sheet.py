"""A lab's evening as one shipped file, run unattended on a simulated bench over a real wire."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from protocols.engine.states import ENERGISED, TRANSITIONS, EngineState
from rig.model.records import Record
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.cli.bench import bramah, outputs_are_zero, simulated

RIG = "shinshu-2dof"
SHEET = ("run", "lab-sheet", "--rig", RIG, "--set", "rest=1 s", "--duration", 2)
COLD = 11  # a seed whose oil is below 40 degC for about a minute, then above


def states(events: list[dict[str, Any]]) -> list[tuple[EngineState, float]]:
    """The states a run went through, each with the time [s] at which it began."""
    return [(EngineState(e["state"]), e["t"]) for e in events if e["event"] == "state"]


def stream(run: Path, channel: str) -> np.ndarray:
    """A channel of the whole run, records and what lies between them, in the order of ticks."""
    with h5py.File(run / "records.h5") as file:
        groups = [file[name] for name in file if name != "between"]
        groups += list(file["between"].values())
        groups.sort(key=lambda group: group.attrs["start_tick"])
        return np.concatenate([group[channel][:] for group in groups])


def stroke(record: Record, hertz: float) -> float:
    """The amplitude [m] of piston 2 at a frequency, by projection on a sine and a cosine."""
    piston = record.channels["piston_2"]
    turn = np.exp(-2j * np.pi * hertz * np.arange(len(piston)) / 1000.0)
    return float(2.0 * abs(np.mean((piston - piston.mean()) * turn)))


@pytest.fixture(scope="module")
def evening(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evening")
    with simulated("--seed", COLD) as (endpoint, _):
        done = bramah(*SHEET, "--out", folder / "run", "--endpoint", endpoint)
        assert done.returncode == 0, done.stderr
        assert outputs_are_zero(endpoint)
    (folder / "said").write_text(done.stderr)
    return folder


def test_every_amplitude_meets_every_frequency_three_times(evening: Path) -> None:
    run = load_run(evening / "run")
    assert run.state == "done"
    names = [f"sine_{k}_r{repeat}" for k in (1, 2, 3, 4) for repeat in (1, 2, 3)]
    assert [record.name for record in run.records] == names
    pairs = list(itertools.product((6e-3, 12e-3), (1.0, 2.0)))
    for record, (size, hertz) in zip(run.records, np.repeat(pairs, 3, axis=0), strict=True):
        about = record.attributes
        assert (about["complete"], about["lost_samples"], record.samples) == (1, 0, 2000)
        assert (about["parameter_amplitude"], about["parameter_frequency"]) == (
            f"{1e3 * size:g} mm", f"{hertz:g} Hz",
        )  # fmt: skip
        assert (record.locked, about["lock_1"], about["excited"]) == ((1,), "closed", "2")
        assert stroke(record, hertz) == pytest.approx(size, rel=0.15)
        assert np.ptp(record.channels["piston_1"]) < 4e-3


def test_repeats_of_one_step_are_the_same_motion(evening: Path) -> None:
    records = load_run(evening / "run").records
    for first, second, third in zip(*[iter(records)] * 3, strict=True):
        motions = [r.channels["piston_2"] - r.channels["piston_2"].mean() for r in
                   (first, second, third)]  # fmt: skip
        for other in motions[1:]:
            assert np.std(other - motions[0]) < 0.05 * np.std(motions[0])


def test_the_question_is_answered_by_its_default_with_the_valves_closed(evening: Path) -> None:
    events = read_events(evening / "run")
    (answer,) = [e for e in events if e["event"] == "answer"]
    assert (answer["answer"], answer["by"]) == ("yes", "the default, after 30 s")
    assert 30.0 <= answer["t"] < 31.0
    ticks = slice(0, answer["tick"])
    for joint in (1, 2):
        assert not stream(evening / "run", f"command_{joint}")[ticks].any()


def test_nothing_is_measured_before_the_oil_is_warm(evening: Path) -> None:
    events = read_events(evening / "run")
    phases = [e for e in events if e["event"] == "phase" and e["step"] == "warm_up"]
    began = next(e["tick"] for e in phases if e["phase"] == "warm-up")
    ended = next(e["tick"] for e in phases if e["phase"] == "stop")
    oil = stream(evening / "run", "oil_temperature")
    assert oil[began : began + 100].mean() < 40.0 - 0.2
    assert oil[ended - 100 : ended].mean() > 40.0
    assert oil[ended - 1000 : ended - 900].mean() < 40.0 + 0.2  # and it moved no longer than that
    assert np.ptp(stream(evening / "run", "piston_1")[began:ended]) > 5e-3
    first = next(e["tick"] for e in events if e["event"] == "record begins")
    assert first > ended


def test_the_states_it_went_through_are_those_of_the_sheet(evening: Path) -> None:
    seen = [state for state, _ in states(read_events(evening / "run"))]
    for before, after in itertools.pairwise([EngineState.IDLE, *seen]):
        assert after in TRANSITIONS[before]
    sine = [EngineState.HOMING, EngineState.LOCKED, EngineState.EXCITING, EngineState.IDLE]
    assert seen == [
        EngineState.CHECKING, EngineState.IDLE, EngineState.PROMPTING, EngineState.IDLE,
        EngineState.HOMING, EngineState.EXCITING, EngineState.IDLE,
        EngineState.HOMING, EngineState.LOCKED, EngineState.IDLE,
        *sine, *sine, *sine, *sine,
        EngineState.SAFE,
    ]  # fmt: skip


def test_outputs_are_other_than_zero_in_energised_states_only(evening: Path) -> None:
    events = read_events(evening / "run")
    commands = [stream(evening / "run", f"command_{joint}") for joint in (1, 2)]
    length = len(commands[0])
    seen = states(events)
    block = 0.02  # [s] a law takes effect within the block after it was asked for
    for (state, begins), (_, ends) in itertools.pairwise(
        [*seen, (EngineState.SAFE, length / 1000.0)]
    ):
        span = slice(round(1000 * (begins + block)), round(1000 * ends))
        if state not in ENERGISED:
            assert not any(command[span].any() for command in commands), (state, begins)
    rests = [e for e in events if e["event"] == "phase" and e["phase"] == "pause"]
    assert len(rests) == 4
    for rest in rests:
        span = slice(rest["tick"] + 20, rest["tick"] + 1000)
        assert not any(command[span].any() for command in commands)


def test_one_clock_runs_through_the_whole_evening(evening: Path) -> None:
    events = read_events(evening / "run")
    times = [event["t"] for event in events]
    assert times == sorted(times)
    assert [e["text"] for e in events if e["event"] == "mark"] == ["all sizes done"]
    said = [line.split() for line in (evening / "said").read_text().splitlines()]
    shown = [float(words[0]) for words in said if words[1:2] == ["s"]]
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(times[-1], abs=0.2)
    proof = json.loads((evening / "run" / "proof.json").read_text())
    assert proof["report"]["ok"]


@pytest.mark.slow
def test_a_trip_follows_the_sheets_rule_and_keeps_what_was_measured(tmp_path: Path) -> None:
    hose = tmp_path / "hose.yaml"
    hose.write_text("faults: [{name: broken_wire, channel: cap_pressure_2, end: high, at: 33 s}]\n")
    run = tmp_path / "run"
    with simulated("--seed", COLD, "--scenario", hose) as (endpoint, _):
        done = bramah(*SHEET, "--out", run, "--endpoint", endpoint)
        assert done.returncode == 3, done.stderr
        assert outputs_are_zero(endpoint)
    last = done.stderr.strip().splitlines()[-1]
    assert "joint 2" in last
    assert "cap_pressure_2" in last
    assert (run / "state").read_text() == "tripped\n"
    events = read_events(run)
    marks = [e["text"] for e in events if e["event"] == "mark"]
    assert marks == ["look at the hoses before anyone resets this bench"]
    seen = [state for state, _ in states(events)]
    assert seen[-2:] == [EngineState.TRIPPED, EngineState.SAFE]
    (trip,) = [e for e in events if e["event"] == "trip"]
    after = {channel: stream(run, channel)[trip["tick"] :] for channel in ("command_2", "piston_2")}
    assert len(after["piston_2"]) >= 5000  # on_trip.record, outputs at zero
    assert not after["command_2"][20:].any()
