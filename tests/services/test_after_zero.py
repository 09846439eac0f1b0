"""Whatever ends a run early, its record goes on until the commands are proved to be zero."""

from __future__ import annotations

import logging
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from drivers.base import DeviceError, DeviceLost, OutputLaw, SampleBlock
from rig.bench.session import Bench
from rig.model.trips import OperatorStop, SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from tests.services.fake_driver import FakeDriver
from tests.services.test_attach import Wall
from tests.services.test_bench import pressure_at

RIG = load_rig("shinshu-2dof")
MOVE = [OutputLaw(bias=1.0, limit=2.0), OutputLaw()]


def commands(run: Path) -> np.ndarray:
    """What the device put out, from the first sample of the run to its last."""
    with h5py.File(run / "records.h5") as file:
        groups = [file[name] for name in file if name != "between"]
        groups += list(file["between"].values())
        groups.sort(key=lambda group: group.attrs["start_tick"])
        return np.concatenate([group["command_1"][:] for group in groups])


def stop_at(number: int):
    return lambda n: os.kill(os.getpid(), signal.SIGINT) if n == number else None


class Aborted(Exception):
    pass


@pytest.mark.parametrize(
    ("ends", "error"), [("trip", SafetyTrip), ("stop", OperatorStop), ("abort", Aborted)]
)
def test_two_seconds_at_zero_are_recorded_after_the_last_command(
    tmp_path: Path, ends: str, error: type[Exception]
) -> None:
    driver = FakeDriver(
        RIG,
        spoil=pressure_at(154) if ends == "trip" else None,
        before_block=stop_at(15) if ends == "stop" else None,
    )
    run = tmp_path / "run"
    with pytest.raises(error), Bench(RIG, driver, Recorder(run, RIG)) as bench:  # noqa: PT012
        bench.apply(MOVE)
        with bench.record(step="s", start_tick=0):
            bench.run_for(1.0 if ends != "abort" else 0.16)
            raise Aborted
    put_out = commands(run)
    assert put_out[:160].min() == 1.0
    assert len(put_out) == 160 + 2000
    assert not put_out[160:].any()


def test_a_driver_that_ends_the_program_has_not_done_the_run(tmp_path: Path) -> None:
    """A user's driver calls sys.exit(): its code 0 would count as a night without faults."""

    def leave(number: int) -> None:
        if number >= 15:
            sys.exit(0)

    driver = FakeDriver(RIG, before_block=leave)
    run = tmp_path / "run"
    with (  # noqa: PT012
        pytest.raises(DeviceError, match=r"ended the program: sys\.exit\(\)"),
        Bench(RIG, driver, Recorder(run, RIG)) as bench,
    ):
        bench.apply(MOVE)
        with bench.record(step="s", start_tick=0):
            bench.run_for(1.0)
    with h5py.File(run / "records.h5") as file:
        (record,) = file.values()
        assert len(record["command_1"]) >= 100  # what was recorded before is there
    assert driver.laws == [OutputLaw()] * 2
    assert driver.calls[-1] == "close"


def test_the_last_picture_of_a_run_that_tripped_has_its_commands_at_zero(tmp_path: Path) -> None:
    """A person before the bench reads from it whether the valves are closed."""
    wall = Wall()
    driver = FakeDriver(RIG, spoil=pressure_at(154))
    recorder = Recorder(tmp_path / "run", RIG)
    with pytest.raises(SafetyTrip), Bench(RIG, driver, recorder, wall) as bench:  # noqa: PT012
        bench.apply(MOVE)
        bench.run_for(1.0)
    tripped = [s for s in wall.seen if s.state == "tripped"]
    assert tripped[0].channels["command_1"].last == 1.0
    assert tripped[-1].channels["command_1"].last == 0.0
    assert tripped[-1].tick == 160 + 2000


def test_what_a_device_had_queued_is_kept_and_two_seconds_of_zero_follow(tmp_path: Path) -> None:
    class Queued(FakeDriver):
        """Its zeroing acts 300 samples after those that the host has read."""

        behind = 30

        def read_block(self) -> SampleBlock:
            block = super().read_block()
            if "zero" in self.calls[-4:] and self.behind and block.tick > 150:
                self.behind -= 1
                data = block.data.copy()
                data[:, -2] = 1.0
                return replace(block, data=data)
            return block

    run = tmp_path / "run"
    driver = Queued(RIG, spoil=pressure_at(154))
    with pytest.raises(SafetyTrip), Bench(RIG, driver, Recorder(run, RIG)) as bench:  # noqa: PT012
        bench.apply(MOVE)
        bench.run_for(1.0)
    put_out = commands(run)
    last = np.flatnonzero(put_out)[-1]
    assert last == 160 + 300 - 1
    assert len(put_out) - 1 - last == 2000


def test_a_device_that_dies_after_the_zeroing_is_not_waited_for(tmp_path: Path) -> None:
    def die(sequence: int) -> None:
        driver.dead = sequence >= 20

    driver = FakeDriver(RIG, spoil=pressure_at(154), before_block=die)
    run = tmp_path / "run"
    with pytest.raises(SafetyTrip), Bench(RIG, driver, Recorder(run, RIG)) as bench:
        bench.run_for(1.0)
    assert len(commands(run)) == 200
    assert "not confirmed" in read_events(run)[-1]["message"]


def test_a_device_that_crawls_ends_the_recording_by_the_clock(tmp_path: Path) -> None:
    now = [0.0]

    def crawl(_: int) -> None:
        now[0] += 1.0

    driver = FakeDriver(RIG, spoil=pressure_at(154), before_block=crawl)
    run = tmp_path / "run"
    with (
        pytest.raises(SafetyTrip),
        Bench(RIG, driver, Recorder(run, RIG), clock=lambda: now[0]) as bench,
    ):
        bench.run_for(1.0)
    assert 160 < len(commands(run)) <= 160 + 90


def test_a_device_that_still_reports_a_command_is_an_alarm_and_in_the_record(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Stuck(FakeDriver):
        def zero_outputs(self) -> None:
            self._note("zero")

    run = tmp_path / "run"
    driver = Stuck(RIG, spoil=pressure_at(154))
    with (  # noqa: PT012
        caplog.at_level(logging.ERROR),
        pytest.raises(SafetyTrip) as caught,
        Bench(RIG, driver, Recorder(run, RIG)) as bench,
    ):
        bench.apply(MOVE)
        bench.run_for(1.0)
    assert "outputs not confirmed at zero: the device still reports a command" in caplog.text
    assert "outputs not confirmed at zero" in caught.value.__notes__
    assert len(commands(run)) == 160 + 6000
    assert "not confirmed" in read_events(run)[-1]["message"]


def test_that_zero_is_not_confirmed_is_said_before_that_the_device_is_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def die(sequence: int) -> None:
        driver.dead = sequence >= 3

    driver = FakeDriver(RIG, before_block=die)
    with caplog.at_level(logging.ERROR), pytest.raises(DeviceLost) as lost, Bench(RIG, driver) as b:
        b.run_for(1.0)
    said = [record.getMessage() for record in caplog.records]
    assert said[0].startswith("outputs not confirmed at zero")
    assert "does not answer" in said[1]
    assert lost.value.__notes__ == ["outputs not confirmed at zero"]


def test_a_device_that_does_not_come_back_leaves_its_outputs_unconfirmed(tmp_path: Path) -> None:
    """The wire is closed before it is opened again: that proves nothing about the valve."""
    driver = FakeDriver(RIG)
    run = tmp_path / "run"
    with (  # noqa: PT012
        pytest.raises(DeviceLost) as lost,
        Bench(RIG, driver, Recorder(run, RIG)) as bench,
    ):
        bench.apply(MOVE)
        bench.run_for(0.1)
        driver.dead = True
        bench.reconnect(0.0)
    assert lost.value.__notes__ == ["outputs not confirmed at zero"]
    assert "not confirmed" in read_events(run)[-1]["message"]


def test_a_device_lost_at_the_very_end_is_no_success(tmp_path: Path) -> None:
    driver = FakeDriver(RIG)
    run = tmp_path / "run"
    with pytest.raises(DeviceLost, match="not confirmed"), Bench(RIG, driver, Recorder(run, RIG)):
        driver.dead = True
    assert (run / "state").read_text() == "done\n"
