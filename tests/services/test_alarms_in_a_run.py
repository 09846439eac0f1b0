"""What a run says of its warnings and trips: while it goes on, afterwards, and to a screen."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from drivers.base import OutputLaw, SampleBlock
from rig.bench.guard import EXCITED, FREE
from rig.bench.screens.commands import Judge
from rig.bench.screens.snapshot import Snapshot, from_json, to_json
from rig.bench.screens.sockets import Command
from rig.bench.session import Bench
from rig.model.alarms.states import AlarmState
from rig.model.trips import SafetyTrip
from rig.runs.exchange.trip_window import write_trip_window
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from tests.services.fake_driver import FakeDriver
from tests.services.test_plausibility import WAVES, driver_of

RIG = load_rig("shinshu-2dof")
PRESSURE = RIG.recorded.index("cap_pressure_1")
Spoil = Callable[[SampleBlock], SampleBlock]


class Screen:
    """A publisher's double that remembers snapshots as they cross the wire, and asks."""

    def __init__(self) -> None:
        self.seen: list[Snapshot] = []
        self.asks: list[Command] = []

    watched = True

    def publish(self, snapshot: Snapshot) -> None:
        self.seen.append(from_json(to_json(snapshot)))

    def commands(self, judge: Judge | None = None) -> list[Command]:
        asked, self.asks = self.asks, []
        return asked

    def close(self) -> None: ...


def high_between(*spans: tuple[int, int], value: float = 8.5e6) -> Spoil:
    """A cap pressure of 7.5 MPa; in spans above what warns (8.1 MPa), below what trips (9 MPa)."""

    def spoil(block: SampleBlock) -> SampleBlock:
        ticks = np.arange(block.tick, block.tick + len(block.data))
        data = block.data.copy()
        data[:, PRESSURE] = 7.5e6
        for first, last in spans:
            data[(ticks >= first) & (ticks < last), PRESSURE] = value
        return replace(block, data=data)

    return spoil


def alarms_of(run: Path, event: str = "alarm") -> list[tuple[str, int]]:
    return [(e["alarm"], e["tick"]) for e in read_events(run) if e["event"] == event]


def take(run: Path, spoil: Spoil, seconds: float, screen: Screen | None = None) -> Bench:
    driver = FakeDriver(RIG, spoil=spoil)
    with Bench(RIG, driver, Recorder(run, RIG), screen, clock=lambda: 0.0) as bench:  # type: ignore[arg-type]
        bench.run_for(seconds)
    return bench


def pressure_alarms(run: Path, event: str = "alarm") -> list[int]:
    key = "pressure: cap_pressure_1"
    return [tick for name, tick in alarms_of(run, event) if name == key]


def test_a_warning_is_written_down_and_the_run_goes_on(tmp_path: Path) -> None:
    run = tmp_path / "run"
    bench = take(run, high_between((300, 600)), 3.0)
    assert pressure_alarms(run) == [350]  # 50 ms outside
    (back,) = pressure_alarms(run, "alarm returned")
    assert 600 + 990 <= back <= 600 + 1020  # 1 s inside
    found = next(a for a in bench.alarms.alarms if a.check == "pressure")
    assert found.state is AlarmState.RETURNED
    assert (found.joint, found.value, found.time) == (1, 8.5e6, 0.35)
    assert found.limit[1] == pytest.approx(8.1e6)
    assert "cap_pressure_1 of joint 1 (boom): 8.5 MPa at 0.3500 s" in found.sentence
    assert found.remedy
    assert read_events(run)[-1]["state"] == "done"


def test_an_alarm_and_a_trip_have_the_times_of_the_run_not_of_the_device(tmp_path: Path) -> None:
    run, up_since = tmp_path / "run", 7_000  # samples that the device took before the run
    warned = high_between((300, 5000))

    def spoil(block: SampleBlock) -> SampleBlock:
        late = warned(block)
        if 900 <= block.tick < 1000:
            late.data[:, PRESSURE] = 9.5e6
        return replace(late, tick=late.tick + up_since)

    with pytest.raises(SafetyTrip, match=r"cap_pressure_1 of joint 1 \(boom\): 9.5 MPa at 0\.9"):
        take(run, spoil, 3.0)
    told = [e for e in read_events(run) if e["event"] in ("alarm", "trip")]
    assert min(e["tick"] for e in told) > up_since
    for event in told:
        words = event["sentence" if event["event"] == "alarm" else "message"]
        assert f" at {event['t']:.4f} s, " in words


def test_a_value_that_chatters_about_its_limit_is_one_alarm(tmp_path: Path) -> None:
    run = tmp_path / "run"
    spans = [(k, k + 60) for k in range(300, 2300, 100)]
    take(run, high_between(*spans), 4.0)
    assert len(pressure_alarms(run)) == 1
    assert len(pressure_alarms(run, "alarm returned")) == 1
    short = tmp_path / "short"
    take(short, high_between(*((k, k + 40) for k in range(300, 2300, 100))), 3.0)
    assert pressure_alarms(short) == []


def test_a_value_within_the_dead_band_keeps_its_warning(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def spoil(block: SampleBlock) -> SampleBlock:
        level = 8.5e6 if 300 <= block.tick < 400 else 8.05e6
        return high_between((300, 2400), value=level)(block)

    take(run, spoil, 4.5)
    assert len(pressure_alarms(run)) == 1
    (back,) = pressure_alarms(run, "alarm returned")
    assert back >= 2400 + 990


def test_a_warning_that_comes_again_is_written_down_with_its_present_value(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def spoil(block: SampleBlock) -> SampleBlock:
        level = 8.5e6 if block.tick < 1000 else 8.7e6
        return high_between((300, 600), (2300, 2600), value=level)(block)

    take(run, spoil, 3.0)
    first, again = [
        e for e in read_events(run) if e["event"] == "alarm" and e["check"] == "pressure"
    ]
    assert (first["value"], first["t"], first["count"]) == (8.5e6, 0.35, 1)
    assert (again["value"], again["t"], again["count"]) == (8.7e6, 2.35, 2)
    for event in read_events(run):
        assert datetime.fromisoformat(event["time"]).tzinfo is not None
    assert "8.7 MPa at 2.3500 s" in again["sentence"]
    assert (again["tick"], again["state"]) == (2350, "active")


def test_a_screen_sees_the_alarms_and_acknowledges_them(tmp_path: Path) -> None:
    run, screen = tmp_path / "run", Screen()
    driver = FakeDriver(RIG, spoil=high_between((300, 5000)))
    ticking = iter(range(1_000_000))
    with Bench(RIG, driver, Recorder(run, RIG), screen, clock=lambda: next(ticking)) as bench:  # type: ignore[arg-type]
        bench.run_for(0.6)
        key = "pressure: cap_pressure_1"
        shown = {a.key: a for a in screen.seen[-1].alarms}
        assert shown[key].state is AlarmState.ACTIVE
        screen.asks = [Command("acknowledge", key), Command("acknowledge", "no such alarm")]
        bench.run_for(0.1)
        shown = {a.key: a for a in screen.seen[-1].alarms}
        assert shown[key].state is AlarmState.ACKNOWLEDGED
        assert bench.alarms.get(key) == shown[key]
    assert [name for name, _ in alarms_of(run, "alarm acknowledged")] == [key]


def broken(tmp_path: Path) -> tuple[Path, SafetyTrip]:
    """A run on the simulated bench that trips while joint 2 is excited."""
    run = tmp_path / "run"
    scenario = "faults: [{name: sensor_stuck, channel: piston_2, at: 2.5 s}]"
    driver = driver_of(scenario)
    with pytest.raises(SafetyTrip) as caught, Bench(RIG, driver, Recorder(run, RIG)) as bench:  # noqa: PT012
        bench.upload(1, WAVES["sine"])
        bench.guard([FREE, EXCITED])
        laws = [OutputLaw(), OutputLaw(1.0, 0.0, 5.0, 0.0, 4.0)]
        with bench.record(step="s", start_tick=bench.apply(laws, restart=True)):
            bench.run_for(6.0)
    return run, caught.value


def test_two_seconds_before_and_after_a_trip_are_beside_the_run(tmp_path: Path) -> None:
    run, trip = broken(tmp_path)
    path = run / "trip.csv"
    assert any(str(path) in note for note in trip.__notes__)
    assert any("Check sensor" in note for note in trip.__notes__)
    names = path.read_text().splitlines()[0].split(",")
    assert names[:2] == ["time [s]", "tick"]
    assert set(names[2:]) == {f"{n} [{RIG.unit_of(n)}]" for n in RIG.recorded}
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 1], np.arange(trip.tick - 2000, table[-1, 1] + 1))
    assert table[-1, 0] >= 1.99
    assert table[2000, 0] == 0.0
    piston = table[:, names.index("piston_2 [m]")]
    assert piston[2000] == pytest.approx(trip.value, rel=1e-6)
    assert np.ptp(piston[: 2500 - trip.tick + 2000]) > 1e-3

    command = table[:, names.index("command_2 [V]")]
    assert command[2000] != 0.0
    # From the offending sample to outputs at zero, on the device's clock.
    assert np.flatnonzero(command)[-1] + 1 - 2000 <= 2 * 10
    events = [e for e in read_events(run) if e["event"] == "alarm" and e["trips"]]
    assert [(e["check"], e["tick"], e["state"]) for e in events] == [
        ("frozen sensor", trip.tick, "latched")
    ]
    # A line of a log is JSON for any reader: an open end of a limit is null.
    lines = (run / "events.jsonl").read_text().splitlines()
    limits = [json.loads(line, parse_constant=pytest.fail).get("limit") for line in lines]
    assert [None, None] in limits
    (tripped,) = (e for e in read_events(run) if e["event"] == "trip")
    assert tripped["within"] == 0.25
    path.unlink()
    assert write_trip_window(run) == path


def test_a_run_without_a_trip_has_no_such_file(tmp_path: Path) -> None:
    take(tmp_path / "run", high_between(), 0.5)
    assert write_trip_window(tmp_path / "run") is None
    assert not (tmp_path / "run/trip.csv").exists()


def test_samples_that_the_host_took_late_are_counted_in_the_run(tmp_path: Path) -> None:
    def host_timed(block: SampleBlock) -> SampleBlock:
        at = (block.tick + np.arange(10)) / RIG.sample_rate
        if block.sequence == 3:
            at[4] += 0.7e-3  # late by more than half a period
            at[7] = np.nan  # interpolated
        return replace(block, read_at=at)

    take(tmp_path / "run", host_timed, 0.1)
    (said,) = [e for e in read_events(tmp_path / "run") if e["event"] == "host timing"]
    assert (said["samples"], said["late"], said["interpolated"]) == (100, 1, 1)
    assert said["worst_late_s"] == pytest.approx(0.7e-3)
    take(tmp_path / "own", high_between(), 0.1)
    assert "host timing" not in [e["event"] for e in read_events(tmp_path / "own")]


def test_a_few_lost_samples_warn_and_do_not_blind_the_checks(tmp_path: Path) -> None:
    run = tmp_path / "run"
    driver = driver_of("faults: [{name: valve_stuck, where: joint 2, at: 1 s}]")
    read = driver.read_block

    def lossy() -> SampleBlock:
        block = read()
        return read() if block.tick % 200 == 0 and block.tick else block

    driver.read_block = lossy  # type: ignore[method-assign]
    with pytest.raises(SafetyTrip) as caught, Bench(RIG, driver, Recorder(run, RIG)) as bench:  # noqa: PT012
        bench.upload(1, WAVES["sine"])
        bench.guard([FREE, EXCITED])
        bench.apply([OutputLaw(), OutputLaw(1.0, 0.0, 5.0, 0.0, 4.0)], restart=True)
        bench.run_for(4.0)
    assert caught.value.limit == "spool does not follow"
    assert caught.value.device_time <= 3.0
    assert "sample gap: bench" in [name for name, _ in alarms_of(run)]
