"""A host meets a device over a real wire: in its own process, and over wires that misbehave."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from drivers import make_driver
from drivers.base import OFF, DeviceError, DeviceLost, OutputLaw
from drivers.modbus_tcp import ModbusTcpDriver
from rig.model.rig import Rig
from tests.drivers.streamed_device import StreamedDevice, read
from tests.drivers.wires import BadWire, device_process
from tests.hil_sim.integrator import expected_outputs, seed_rig

TIMEOUT = 0.4


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with device_process("virtual") as (_, port):
        yield port


@pytest.fixture
def driver(port: int) -> Iterator[ModbusTcpDriver]:
    rig = seed_rig(port=port)
    driver = make_driver(rig.wire, rig)
    assert isinstance(driver, ModbusTcpDriver)
    driver.connect()
    driver.reset()
    yield driver
    driver.close()


@pytest.fixture
def wire(port: int) -> Iterator[BadWire]:
    wire = BadWire(port)
    yield wire
    wire.close()


def over(wire: BadWire) -> ModbusTcpDriver:
    rig = seed_rig(port=wire.port, timeout=TIMEOUT)
    driver = ModbusTcpDriver(rig.wire, rig)
    driver.connect()
    driver.reset()
    return driver


@pytest.fixture
def made_for(port: int) -> Callable[[Rig], ModbusTcpDriver]:
    return lambda rig: ModbusTcpDriver(seed_rig(port=port).wire, rig)


class TestModbusDevice(StreamedDevice):
    """The tests that this wire has in common with others."""


def test_a_saturated_sensor_is_marked(driver: ModbusTcpDriver) -> None:
    # 4 V for 1 s moves the integrator's piston 80 mm, past the sensor's 40.
    driver.start()
    driver.apply([OFF, OutputLaw(bias=4.0, limit=4.0)])
    blocks = [driver.read_block() for _ in range(250)]
    assert not blocks[0].saturated[:, 5].any()
    assert blocks[-1].saturated[:, 5].all()
    assert blocks[-1].data[-1, 5] == 0.04
    driver.apply([OFF, OutputLaw(position_gain=1000.0, limit=4.0)])
    read(driver, 400)


def test_a_long_waveform_crosses_the_wire_whole(driver: ModbusTcpDriver) -> None:
    wave = np.random.default_rng(7).uniform(-2.0, 2.0, 60_000)
    driver.upload(0, wave)
    driver.start()
    driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    played = read(driver, 6_001)[:, 10]
    # Rounded twice, to 16 bits when stored and to 12 when put out: at most one step apart.
    wanted = expected_outputs(np.append(wave, wave[:10]), seed_rig())
    assert played == pytest.approx(wanted, abs=1.001 * 10 / 2047)


def test_a_second_host_cannot_take_over_but_can_make_it_safe(driver: ModbusTcpDriver) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    rig = seed_rig(port=driver._wire.settings["port"])
    other = ModbusTcpDriver(rig.wire, rig)
    with pytest.raises(DeviceError, match="another client has control"):
        other.connect()
    assert read(driver, 1)[:, 10].min() > 0.9
    other.zero_outputs()
    assert np.all(read(driver, 1)[:, 10:] == 0.0)
    other.close()
    assert driver.trip_cause() is None


def test_a_lost_answer_is_asked_for_again_and_no_sample_is_missing(wire: BadWire) -> None:
    driver = over(wire)
    driver.start()
    first = driver.read_block()
    wire.fault = "lose one"
    second = driver.read_block()
    third = driver.read_block()
    assert wire.fault == "pass"
    assert [b.tick - first.tick for b in (second, third)] == [10, 20]
    assert [b.sequence for b in (first, second, third)] == [0, 1, 2]
    driver.close()


def test_blocks_asked_for_ahead_are_those_that_would_have_come(driver: ModbusTcpDriver) -> None:
    wave = 3.0 * np.sin(2 * np.pi * np.arange(250) / 250)
    driver.upload(1, wave)

    def played(ahead: bool) -> np.ndarray:
        driver.start()
        tick = driver.apply([OFF, OutputLaw(gain=0.5, limit=1.5)], restart=True)
        blocks = []
        for _ in range(50):
            blocks.append(driver.read_block())
            if ahead:
                driver.ask_ahead()
        assert [block.tick - tick for block in blocks] == list(range(0, 500, 10))
        return np.vstack([block.data for block in blocks])[:, 10:]

    assert np.array_equal(played(ahead=True), played(ahead=False))


def test_a_command_before_the_answer_ahead_is_obeyed_and_loses_no_block(
    driver: ModbusTcpDriver, caplog: pytest.LogCaptureFixture
) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    blocks = [driver.read_block()]
    driver.ask_ahead()
    driver.zero_outputs()
    # One block was measured before the zero arrived: at most two from a bad sample to zero.
    blocks += [driver.read_block(), driver.read_block()]
    assert [(block.data[:, 10] > 0.9).all() for block in blocks] == [True, True, False]
    assert not blocks[2].data[:, 10:].any()
    driver.ask_ahead()
    assert driver.trip_cause() is None
    driver.ask_ahead()
    tick = driver.apply([OFF, OutputLaw(bias=1.0, limit=2.0)])
    blocks += [driver.read_block(), driver.read_block()]
    assert tick == blocks[-1].tick
    assert [block.tick - blocks[0].tick for block in blocks] == [0, 10, 20, 30, 40]
    assert not caplog.messages


def test_a_lost_answer_ahead_is_asked_for_again(wire: BadWire) -> None:
    driver = over(wire)
    driver.start()
    blocks = [driver.read_block()]
    wire.fault = "lose one"
    driver.ask_ahead()
    blocks += [driver.read_block(), driver.read_block()]
    assert wire.fault == "pass"
    assert [block.sequence for block in blocks] == [0, 1, 2]
    driver.close()


def test_nothing_is_asked_ahead_in_real_time() -> None:
    with device_process("realtime") as (_, port):
        rig = seed_rig(port=port)
        driver = ModbusTcpDriver(rig.wire, rig)
        driver.connect()
        driver.start()
        driver.read_block()
        driver.ask_ahead()
        assert not driver._link.asked_ahead
        driver.close()


@pytest.mark.parametrize("ahead", [False, True])
@pytest.mark.parametrize(
    ("fault", "error", "says"),
    [
        ("silent", DeviceLost, "has not answered for 0.4 s"),
        ("close", DeviceLost, "closed"),
        ("garbage", DeviceError, "no Modbus answer"),
        ("short", DeviceError, "no Modbus answer"),
        ("fewer", DeviceError, "4 bytes to function 23, expected 250"),
        ("miscounted", DeviceError, "no Modbus answer"),
    ],
)
def test_a_wire_that_fails_mid_run_is_named_in_time(
    wire: BadWire, fault: str, error: type[DeviceError], says: str, ahead: bool
) -> None:
    driver = over(wire)
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    wire.fault = fault
    began = time.monotonic()
    if ahead:
        driver.ask_ahead()
    with pytest.raises(error, match=says) as caught:
        driver.read_block()
    assert time.monotonic() - began < 2 * TIMEOUT + 5.0
    assert isinstance(caught.value, DeviceLost) == (error is DeviceLost)
    # Zeroing tries anew, over a wire that has recovered...
    wire.fault = "pass"
    driver.zero_outputs()
    driver.close()


@pytest.mark.parametrize("fault", ["silent", "garbage", "close"])
def test_zeroing_over_a_dead_wire_ends_in_time_and_closing_never_raises(
    wire: BadWire, fault: str
) -> None:
    driver = over(wire)
    wire.fault = fault
    began = time.monotonic()
    with pytest.raises(DeviceError):
        driver.zero_outputs()
    driver.close()
    assert wire.connections == 2
    assert time.monotonic() - began < 3 * TIMEOUT + 5.0


@pytest.mark.parametrize("fault", ["silent", "garbage", "close", "fewer"])
def test_connecting_to_something_else_is_refused(wire: BadWire, fault: str) -> None:
    rig = seed_rig(port=wire.port, timeout=TIMEOUT)
    wire.fault = fault
    with pytest.raises(DeviceError):
        ModbusTcpDriver(rig.wire, rig).connect()


def test_nobody_listening_is_a_lost_device() -> None:
    wire = BadWire(1)
    wire.close()
    rig = seed_rig(port=wire.port)
    with pytest.raises(DeviceLost, match=rf"127.0.0.1:{wire.port}.*bramah sim"):
        ModbusTcpDriver(rig.wire, rig).connect()


def test_a_host_that_vanished_leaves_a_trip_that_only_a_reset_clears(port: int) -> None:
    rig = seed_rig(port=port)
    gone = ModbusTcpDriver(rig.wire, rig)
    gone.connect()
    gone.reset()
    gone.start()
    gone.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    gone.read_block()
    gone._link.close()  # as when its process dies: no goodbye

    driver = ModbusTcpDriver(rig.wire, rig)
    driver.connect()
    assert "connection ended" in (driver.trip_cause() or "")
    driver.start()
    assert driver.read_block().tripped
    with pytest.raises(DeviceError, match=r"connection ended.*reset"):
        driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.apply([OFF, OFF])  # what keeps the outputs at zero is always allowed
    driver.reset()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    block = driver.read_block()
    assert not block.tripped
    assert block.data[:, 10].min() > 0.9
    driver.close()
