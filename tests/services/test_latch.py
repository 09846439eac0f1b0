"""A trip outlives its process: no session begins until a person has cleared it with a reason."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.base import (
    OFF,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    SampleBlock,
)
from rig.bench.latch import (
    BenchState,
    Holder,
    bench_name,
    known_rigs,
    reset_bench,
    state_folder,
    tripped_rigs,
)
from rig.bench.session import Bench
from rig.cli.errors import code_and_message
from rig.model.parse import InputError
from rig.model.trips import Latched, SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events, read_state
from tests.services.fake_driver import FakeDriver

RIG = load_rig("shinshu-2dof")


def too_much(block: SampleBlock) -> SampleBlock:
    data = block.data.copy()
    data[:, RIG.recorded.index("cap_pressure_1")] = 9.5e6
    return replace(block, data=data)


@pytest.fixture
def tripped(tmp_path: Path) -> Path:
    """A run that tripped on a pressure."""
    run = tmp_path / "monday"
    driver = FakeDriver(RIG, spoil=too_much)
    with pytest.raises(SafetyTrip), Bench(RIG, driver, Recorder(run, RIG)) as bench:
        bench.exchange()
    return run


def test_the_next_session_is_refused_with_trip_time_run_and_the_way_out(tripped: Path) -> None:
    driver = FakeDriver(RIG)
    with pytest.raises(Latched) as refused, Bench(RIG, driver):
        pytest.fail("a session began")
    said = str(refused.value)
    assert "limit 'pressure', cap_pressure_1 of joint 1 (boom): 9.5 MPa" in said
    assert f"in run {tripped}" in said
    assert re.search(r"tripped at \d{4}-\d\d-\d\dT", said)
    assert "`bramah reset --rig shinshu-2dof --endpoint modbus-tcp://127.0.0.1:5020" in said
    assert "connect" not in driver.calls


def test_a_reset_keeps_who_when_why_and_which_trip(tripped: Path, state: Path) -> None:
    reset_bench(RIG, FakeDriver(RIG), "  sensor 1 replaced ")
    (entry,) = map(json.loads, next(state.rglob("resets.jsonl")).read_text().splitlines())
    assert entry["reason"] == "sensor 1 replaced"
    assert entry["who"]
    assert entry["trip"]["run"] == str(tripped)
    assert "9.5 MPa" in entry["trip"]["trip"]
    last = read_events(tripped)[-1]
    assert (last["event"], last["reason"]) == ("trip cleared", "sensor 1 replaced")
    with Bench(RIG, FakeDriver(RIG)) as bench:
        bench.exchange()


def test_the_rig_of_a_trip_is_kept_also_where_no_run_is_recorded() -> None:
    """A manual session has no run folder, and a message states the name in a rig file."""
    own = RIG.model_copy(update={"name": "my-bench"})
    with pytest.raises(SafetyTrip), Bench(own, FakeDriver(own, spoil=too_much)) as bench:
        bench.exchange()
    (described,) = tripped_rigs()
    assert load_rig(described) == own
    reset_bench(own, FakeDriver(own), "sensor 1 replaced")
    assert tripped_rigs() == []
    assert known_rigs() == [described]


class HoldsTrip(FakeDriver):
    def close_tripped(self) -> None:
        self.close()


@pytest.mark.parametrize("kind", [FakeDriver, HoldsTrip])
def test_a_trip_says_where_no_other_computer_is_refused(kind: type[FakeDriver]) -> None:
    with pytest.raises(SafetyTrip) as tripped, Bench(RIG, kind(RIG, spoil=too_much)) as bench:
        bench.exchange()
    said = "; ".join(tripped.value.__notes__)
    assert "clear the trip with `bramah reset" in said
    assert ("latched on this computer only" in said) == (kind is FakeDriver)


class ValveFault(FakeDriver):
    """Valves of which one finds a fault of its own between a block and the next law."""

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        self.latched = "valve 1 is in FAULT_DISABLED"
        raise DeviceError(f"tripped: {self.latched}; find the cause, then reset it")


def test_a_device_that_refuses_a_law_since_it_tripped_is_a_trip_and_no_lost_device(
    tmp_path: Path,
) -> None:
    run = tmp_path / "monday"
    driver = ValveFault(RIG)
    with pytest.raises(SafetyTrip) as tripped, Bench(RIG, driver, Recorder(run, RIG)) as bench:
        bench.apply([OutputLaw(bias=0.1, limit=1.0)] * 2)
    code, message = code_and_message(tripped.value)
    assert code == 3
    assert "limit 'device watchdog or fault'" in message
    assert "device: valve 1 is in FAULT_DISABLED" in message
    assert driver.laws == [OFF, OFF]
    assert read_state(run) == "tripped"
    assert any(event["event"] == "trip" for event in read_events(run))
    with pytest.raises(Latched), Bench(RIG, FakeDriver(RIG)):
        pytest.fail("a session began")


@pytest.mark.parametrize("reason", ["", "  "])
def test_a_reset_without_a_reason_clears_nothing(tripped: Path, reason: str) -> None:
    driver = FakeDriver(RIG)
    with pytest.raises(InputError, match="--reason TEXT is missing"):
        reset_bench(RIG, driver, reason)
    assert driver.calls == []
    with pytest.raises(Latched), Bench(RIG, driver):
        pytest.fail("a session began")


def test_a_reset_that_the_device_does_not_hear_clears_nothing(tripped: Path) -> None:
    driver = FakeDriver(RIG)
    driver.dead = True
    with pytest.raises(DeviceLost):
        reset_bench(RIG, driver, "looked at it")
    assert BenchState(RIG.wire).read_trip() is not None


def test_the_first_trip_is_the_one_that_is_kept(tripped: Path) -> None:
    kept = BenchState(RIG.wire)
    before = kept.read_trip()
    assert kept.latch("another", RIG, None)
    assert kept.read_trip() == before


def test_a_damaged_note_of_a_trip_is_still_a_trip(tripped: Path, state: Path) -> None:
    next(state.rglob("trip.json")).write_text('{"trip": "safety tr')
    with pytest.raises(Latched, match="cannot be read"), Bench(RIG, FakeDriver(RIG)):
        pytest.fail("a session began")


def test_a_bench_is_its_endpoint_whatever_the_rig_file_calls_it(tripped: Path) -> None:
    renamed = RIG.model_copy(update={"name": "copy-of-it"})
    with pytest.raises(Latched), Bench(renamed, FakeDriver(renamed)):
        pytest.fail("a session began")
    here = RIG.wire.reached_by("modbus-tcp", {**RIG.wire.settings, "host": "localhost"})
    for name in ("127.1", "127.0.1.1", "LocalHost", socket.gethostname()):
        assert bench_name(f"modbus-map://{name}:5020") == bench_name("modbus-map://127.0.0.1:5020")
    assert bench_name("modbus-map://12.7.0.1:5020") != bench_name("modbus-map://127.0.0.1:5020")
    assert BenchState(here).read_trip() is not None
    elsewhere = RIG.model_copy(update={"wire": RIG.wire.model_copy(update={"port": 5021})})
    with Bench(elsewhere, FakeDriver(elsewhere)) as bench:
        bench.exchange()


def test_where_a_trip_could_not_be_kept_nothing_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BRAMAH_STATE", str(tmp_path / "file"))
    driver = FakeDriver(RIG)
    with pytest.raises(InputError, match="BRAMAH_STATE"), Bench(RIG, driver):
        pytest.fail("a session began")
    assert "connect" not in driver.calls


def test_the_state_folder_is_the_named_one_or_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRAMAH_STATE", "/a/b")
    assert state_folder() == Path("/a/b")
    monkeypatch.delenv("BRAMAH_STATE")
    monkeypatch.setenv("XDG_STATE_HOME", "/c")
    assert state_folder() == Path("/c/bramah")
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_folder() == Path.home() / ".local/state/bramah"


class Busy(FakeDriver):
    def connect(self) -> DeviceInfo:
        raise DeviceBusy("another client has control of the device")


def test_a_bench_in_use_is_refused_with_the_run_and_process_that_have_it(tmp_path: Path) -> None:
    run = tmp_path / "monday"
    with Bench(RIG, FakeDriver(RIG), Recorder(run, RIG), signals=False):
        with pytest.raises(DeviceBusy) as refused, Bench(RIG, Busy(RIG), signals=False):
            pytest.fail("two sessions with one bench")
        assert f"process {os.getpid()}, which writes {run}" in str(refused.value)
        assert BenchState(RIG.wire).holder() is not None
    assert BenchState(RIG.wire).holder() is None
    with (
        pytest.raises(DeviceBusy, match="no known process of this computer"),
        Bench(RIG, Busy(RIG)),
    ):
        pytest.fail("two sessions with one bench")


def test_a_holder_that_died_is_none(state: Path) -> None:
    kept = BenchState(RIG.wire)
    kept.prepare()
    kept.take(None)
    note = kept.folder / "session.json"
    assert kept.holder() == Holder(**json.loads(note.read_text()))
    note.write_text('{"pid": 4194304, "started": "1", "run": ""}')
    assert kept.holder() is None


HOLDS_THE_BENCH = """
import sys
from pathlib import Path
from rig.bench.session import Bench
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from tests.services.fake_driver import FakeDriver
rig = load_rig("shinshu-2dof")
with Bench(rig, FakeDriver(rig), Recorder(Path(sys.argv[1]), rig)) as bench:
    print("at work", flush=True)
    while True:
        bench.exchange()
"""


def test_a_bench_that_another_process_runs_is_not_even_asked(tmp_path: Path) -> None:
    """A device that knows no sessions would serve both programs, each with half of the answers."""
    run, root = tmp_path / "monday", Path(__file__).parents[2]
    words = [sys.executable, "-c", HOLDS_THE_BENCH, str(run)]
    with subprocess.Popen(words, cwd=root, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "at work\n"
            driver = FakeDriver(RIG)
            with pytest.raises(DeviceBusy) as refused, Bench(RIG, driver, signals=False):
                pytest.fail("two sessions with one bench")
            assert f"in use by process {other.pid} of this computer, which writes {run};" in str(
                refused.value
            )
            with pytest.raises(DeviceBusy), BenchState(RIG.wire).occupied():
                pytest.fail("a probe beside a run")
            with pytest.raises(DeviceBusy, match="in use by process"):
                reset_bench(RIG, driver, "a reset beside a run")
            assert {"connect", "zero", "reset"}.isdisjoint(driver.calls)
        finally:
            other.kill()
            other.wait()
    with Bench(RIG, FakeDriver(RIG), signals=False) as bench:  # the lock died with its process
        bench.exchange()
