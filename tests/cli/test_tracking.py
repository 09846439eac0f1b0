"""Following b and the gains beside a run: right, and never in the run's way."""

from __future__ import annotations

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from analysis.identify.streams.online import Tracker, track
from drivers.base import SampleBlock
from rig.bench.observers import Observers
from rig.bench.session import Bench
from rig.cli.execution import tracking as tracking_module
from rig.cli.execution.tracking import Follower, Tracking, summary
from rig.model.records import Record, Run, head_of
from rig.model.rig import Rig
from rig.runs.recorder import RecordMeta
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.analysis import small_bench
from tests.cli.bench import SHORT, bramah, bramah_here, simulated
from tests.services.fake_driver import FakeDriver

RIG = "shinshu-2dof"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(scope="module")
def record(rig: Rig) -> Record:
    step = small_bench.STEPS[0]
    excitations = small_bench.default_excitations(1, 0.025)
    run: Run = small_bench.experiment(rig, excitations, repeats=1, seed=1, steps=(step,))
    return run.records[0]


def blocks(rig: Rig, record: Record, first: int, size: int = 10) -> list[tuple[int, np.ndarray]]:
    """The record's samples as a bench would send them, its first at tick `first`."""
    fill = np.zeros(record.samples)
    data = np.column_stack([record.channels.get(name, fill) for name in rig.recorded])
    return [(first + k, data[k : k + size]) for k in range(0, record.samples, size)]


def test_samples_and_records_meet_by_tick(rig: Rig, record: Record) -> None:
    """Announced late, with samples before and after it, and blocks that got lost."""
    tracker, plain = Tracker(rig), Tracker(rig)
    follower = Follower(rig, tracker)
    stream = blocks(rig, record, 5000)
    for number, (tick, data) in enumerate(stream):
        if number == 7:
            follower.begins(head_of(record), 5003, 9000)
        if 300 <= number < 303:
            continue
        follower.block(tick, data)
    follower.ends(5003, 9000, complete=True)
    channels = {name: x[3:9003].copy() for name, x in record.channels.items()}
    for x in channels.values():
        x[2997:3027] = np.nan
    track(plain, replace(record, channels=channels))
    found, expected = tracker.estimates(), plain.estimates()
    assert found["b"].value == pytest.approx(expected["b"].value, rel=1e-9)
    assert found["C_pp_2"].value == pytest.approx(expected["C_pp_2"].value, rel=1e-9)


def block_of(rig: Rig, tick: int, data: np.ndarray) -> SampleBlock:
    saturated = np.zeros((len(data), len(rig.channels)), dtype=bool)
    return SampleBlock(0, tick, data, saturated, 0, False)


def test_the_process_beside_the_run_finds_what_is_found_here(
    rig: Rig, record: Record, tmp_path: Path
) -> None:
    said: list[str] = []
    noted: list[dict[str, object]] = []
    meta = RecordMeta("step1", 1, record.locked, record.period, record.lines)
    with Tracking(rig, tmp_path, said.append) as tracking:
        tracking.subscribe(noted.append, lambda _: None)
        tracking.record_begins(meta, 100, None)
        for tick, data in blocks(rig, record, 100):
            tracking.block(block_of(rig, tick, data))
        tracking.record_ends(meta, 100, record.samples, "complete")
        short = RecordMeta("more", 1, record.locked, record.period, record.lines)
        after = 100 + record.samples
        tracking.record_begins(short, after, 200)
        for tick, data in blocks(rig, record, after):
            if tick < after + 200:
                tracking.block(block_of(rig, tick, data))
        tracking.record_ends(short, after, 200, "complete")
    here = Tracker(rig)
    track(here, record)
    kept = json.loads((tmp_path / "tracked.json").read_text())
    assert kept["memory_s"] is None
    one, other = kept["records"]
    assert (one["record"], other["record"]) == ("step1_r1", "more_r1")
    assert one["rows"] > 0 == other["rows"]
    assert other["parameters"] == one["parameters"]
    assert any("'more_r1' changes no estimate: it is too short" in line for line in said)
    for name, estimate in here.estimates().items():
        found = kept["parameters"][name]
        if estimate.identified:
            assert found["value"] == pytest.approx(estimate.value, rel=1e-12)
            assert found["std"] == pytest.approx(estimate.std, rel=1e-6)
        else:
            assert found["value"] is None
    assert said[-1].startswith("tracked: b 23")


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    ("number", "why"),
    [(signal.SIGKILL, "ended with signal 9"), (signal.SIGSTOP, "did not answer in 0.5 s")],
)
def test_estimates_that_are_missing_are_said_to_be_so_and_why(
    rig: Rig, record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture, number: signal.Signals, why: str, known: bool,
) -> None:  # fmt: skip
    """The tracker's process ends or hangs, before its first answer or after some."""
    monkeypatch.setattr(tracking_module, "FINISH_SECONDS", 0.5)
    meta = RecordMeta("step1", 1, record.locked, record.period, record.lines)
    with Tracking(rig, tmp_path, lambda _: None) as tracking:
        pid = tracking._process.pid
        assert pid is not None
        tracking.record_begins(meta, 0, None)
        for tick, data in blocks(rig, record, 0):
            tracking.block(block_of(rig, tick, data))
        while known and not tracking.parameters:
            time.sleep(0.01)
            tracking._receive()
        os.kill(pid, number)
        if number == signal.SIGKILL:
            tracking._process.join(20)
    (event,) = [e for e in read_events(tmp_path) if e["event"] == "not tracked"]
    for told in (event["message"], caplog.text):
        assert f"the tracker {why}: estimates are missing" in told
    assert (tmp_path / "tracked.json").exists() == known


def test_a_tracker_that_dies_costs_the_run_nothing(
    rig: Rig, record: Record, tmp_path: Path
) -> None:
    with Tracking(rig, tmp_path, lambda _: None) as tracking:
        pid = tracking._process.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        tracking._process.join(20)
        started = time.monotonic()
        for tick, data in blocks(rig, record, 0):
            tracking.block(block_of(rig, tick, data))
        # A thousand blocks; anything that waits for the dead would take for ever.
        assert time.monotonic() - started < 10
    assert not (tmp_path / "tracked.json").exists()


class Broken:
    """An observer with a fault."""

    calls = 0

    def block(self, block: SampleBlock) -> None:
        self.calls += 1
        raise RuntimeError("a fault of the observer's")

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        pass

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        pass


class Seeing:
    """An observer that remembers."""

    def __init__(self) -> None:
        self.ticks: list[int] = []
        self.heard: list[tuple[object, ...]] = []

    def block(self, block: SampleBlock) -> None:
        self.ticks.append(block.tick)

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        self.heard.append(("begins", meta.name, start))

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        self.heard.append(("ends", meta.name, start, ticks, state))


def test_observers_see_all_and_one_with_a_fault_is_dismissed(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    broken, seeing = Broken(), Seeing()
    with Bench(rig, FakeDriver(rig), signals=False) as bench:
        bench.observers.add(broken)
        bench.observers.add(seeing)
        bench.run_for(0.05)
        with bench.record(step="step1", repeat=1):
            bench.run_for(0.02)
        with bench.record(step="step1", repeat=2) as other:
            bench.run_for(0.02)
            other.discard("disturbed")
    assert broken.calls == 1
    assert "Broken failed and is removed" in caplog.text
    assert seeing.ticks == list(range(0, 90, 10))
    assert seeing.heard == [
        ("begins", "step1_r1", 50),
        ("ends", "step1_r1", 50, 20, "complete"),
        ("begins", "step1_r2", 70),
        ("ends", "step1_r2", 70, 20, "discarded"),
    ]
    assert isinstance(bench.observers, Observers)


def test_a_run_is_tracked_to_what_identify_finds(tmp_path: Path) -> None:
    protocol, run = tmp_path / "short.yaml", tmp_path / "monday"
    protocol.write_text(SHORT)
    with simulated("--seed", 5) as (endpoint, _):
        done = bramah(
            "run", protocol, "--rig", RIG, "--out", run, "--endpoint", endpoint, "--track"
        )
    assert done.returncode == 0, done.stderr
    assert "tracked: b " in done.stderr
    kept = json.loads((run / "tracked.json").read_text())["parameters"]
    expected = identify([load_run(run)], reject_noise=False, estimator=PLAIN).estimates
    for name in ("b", "C_pp_2", "C_pm_2", "C_mp_2", "C_mm_2"):
        assert kept[name]["value"] == pytest.approx(expected[name].value, rel=1e-9)
    assert not [e for e in read_events(run) if e["event"] == "not tracked"]
    records = [e["record"] for e in read_events(run) if e["event"] == "tracked"]
    assert records == ["step1_r1", "step1_r2"]
    wrong = bramah_here(
        "run", protocol, "--rig", RIG, "--out", tmp_path / "x", "--track", "--memory", 0
    )
    assert wrong.returncode == 2
    assert "--memory 0: expected more than 0 s" in wrong.stderr


@pytest.mark.parametrize("memory", ["0", "-1", "nan", "-inf"])
def test_a_memory_that_cannot_be_is_refused_before_anything_is_read(memory: str) -> None:
    done = bramah_here(
        "run", "no-protocol", "--rig", "no-rig", "--out", "x", "--track", "--memory", memory
    )
    assert done.returncode == 2
    assert "--memory" in done.stderr
    assert "no-rig" not in done.stderr


def test_one_line_says_what_is_known() -> None:
    known = {"value": 233.4e6, "ci95": [232.4e6, 234.4e6]}
    unknown = {"value": None, "ci95": [None, None]}
    assert summary({"b": known, "C_pp_1": unknown}) == "b 233.4±1.0 MPa  C_pp_1 ?"
