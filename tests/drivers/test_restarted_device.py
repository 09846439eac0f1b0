"""A device that restarts, jumps in time or loses blocks under a running driver."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest

from drivers import make_driver, wire_at
from drivers.base import DeviceError, DeviceLost, Driver, OutputLaw, SampleBlock
from hil_sim.device.device import Device
from hil_sim.faults.device import ClockDrift, ClockJump, DeviceFault, QueueOverrun, Reboots
from hil_sim.link.served import ServedDevice
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

WIRES = ("modbus-tcp", "modbus-rtu", "serial")
DRIVING = [OutputLaw(bias=0.5, limit=1.0), OutputLaw()]


@contextmanager
def streaming(wire: str, *faults: DeviceFault) -> Iterator[tuple[Driver, ServedDevice]]:
    """A driver that drives joint 1 of a device with these faults."""
    rig = seed_rig(timeout=0.6)
    device = Device(rig, IntegratorPlant(rig), realtime=False, faults=faults)
    with ServedDevice(device, wire) as served:
        driver = make_driver(wire_at(served.link.endpoint, rig.wire), rig)
        driver.connect()
        driver.start()
        driver.apply(DRIVING, restart=True)
        try:
            yield driver, served
        finally:
            driver.close()


def until_error(driver: Driver) -> tuple[list[SampleBlock], DeviceError]:
    """Read until the driver raises; every block must continue the one before."""
    blocks: list[SampleBlock] = []
    found: DeviceError | None = None
    while found is None and len(blocks) < 50:
        try:
            blocks.append(driver.read_block())
        except DeviceError as error:
            found = error
    assert found is not None
    ticks = np.concatenate([block.tick + np.arange(len(block.data)) for block in blocks])
    assert np.array_equal(ticks, np.arange(len(ticks)))
    return blocks, found


@pytest.mark.parametrize("wire", WIRES)
def test_a_restarted_device_is_lost_and_no_sample_of_its_new_life_joins_the_old(wire: str) -> None:
    with streaming(wire, Reboots(name="reboots", at=0.1, boot=0.05)) as (driver, served):
        blocks, error = until_error(driver)
        assert isinstance(error, DeviceLost), error
        assert sum(len(block.data) for block in blocks) == 100
        assert not served.inside(lambda: served.device.laws.armed)
        assert not any(served.inside(lambda: list(served.device.outputs)))


def test_a_silent_line_says_that_its_device_has_restarted() -> None:
    for wire in ("modbus-rtu", "serial"):
        with streaming(wire, Reboots(name="reboots", at=0.1, boot=0.0)) as (driver, _):
            _, error = until_error(driver)
            assert "has restarted" in str(error), (wire, error)


@pytest.mark.parametrize("wire", WIRES)
def test_a_law_for_a_device_that_restarted_unseen_is_no_success(wire: str) -> None:
    with streaming(wire) as (driver, served):
        for _ in range(3):
            driver.read_block()
        served.inside(lambda: served.device.restart(0.0))
        with pytest.raises(DeviceError):
            driver.apply(DRIVING)


@pytest.mark.parametrize("wire", WIRES)
def test_after_its_restart_a_device_serves_a_new_session(wire: str) -> None:
    with streaming(wire, Reboots(name="reboots", at=0.1, boot=0.05)) as (driver, _):
        until_error(driver)
        driver.close()
        time.sleep(0.06)
        driver.connect()
        driver.start()
        block = driver.read_block()
        assert block.sequence == 0
        assert not block.data[:, -2:].any()


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("step", [0.05, -0.05])
def test_a_jump_of_the_devices_clock_is_refused(wire: str, step: float) -> None:
    with streaming(wire, ClockJump(name="clock_jump", at=0.1, step=step)) as (driver, _):
        blocks, error = until_error(driver)
        assert len(blocks) == 10
        assert "impossible block" in str(error)


@pytest.mark.parametrize("wire", WIRES)
def test_blocks_that_the_device_lost_are_counted(wire: str) -> None:
    with streaming(wire, QueueOverrun(name="queue_overrun", at=0.1, blocks=3)) as (driver, _):
        blocks: Sequence[SampleBlock] = [driver.read_block() for _ in range(12)]
    assert [block.sequence for block in blocks] == [*range(10), 13, 14]
    assert [block.tick for block in blocks] == [*range(0, 100, 10), 130, 140]


def test_a_fast_clock_takes_more_samples_a_second() -> None:
    now = [0.0]
    rig = seed_rig()
    drift = ClockDrift(name="clock_drift", at=1.0, until=2.5, rate=0.5)
    device = Device(rig, IntegratorPlant(rig), realtime=True, clock=lambda: now[0], faults=[drift])
    for _ in range(300):
        now[0] += 0.01
        device.poll()
    # 1 s as it should be, 1.5 s of samples in 1 s, 1 s as it should be
    assert abs(device.tick - 3500) <= 20
