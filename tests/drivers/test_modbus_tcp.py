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
from rig.model.wire.codes import decode_input
from tests.drivers.wires import BadWire, device_process
from tests.hil_sim.integrator import SPEED_PER_VOLT, expected_outputs, seed_rig

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


def read(driver: ModbusTcpDriver, blocks: int) -> np.ndarray:
    return np.vstack([driver.read_block().data for _ in range(blocks)])


def test_a_device_says_who_it_is(driver: ModbusTcpDriver) -> None:
    info = driver.info
    assert info is not None
    assert (info.identity, info.joints, info.channels) == ("shinshu-2dof", 2, 10)
    assert (info.sample_rate, info.block_samples, info.virtual_time) == (1000.0, 10, True)


def test_an_uploaded_waveform_is_played_sample_by_sample(driver: ModbusTcpDriver) -> None:
    wave = 3.0 * np.sin(2 * np.pi * np.arange(250) / 250)
    driver.upload(1, wave)
    driver.start()
    driver.read_block()
    law = OutputLaw(gain=0.5, bias=0.25, limit=1.5)
    tick = driver.apply([OFF, law], restart=True)
    blocks = [driver.read_block() for _ in range(75)]
    assert blocks[0].tick == tick
    data = np.vstack([block.data for block in blocks])
    wanted = np.clip(0.5 * np.tile(wave, 3) + 0.25, -1.5, 1.5)
    # One step of the 12-bit converter is 10 V / 2047; the stored waveform is finer than that.
    assert data[:, 11] == pytest.approx(wanted, abs=0.51 * 10 / 2047 + 1e-4)
    assert np.all(data[:, 10] == 0.0)
    # The plant integrates exactly what was put out: s_k = s_0 + rate sum v.
    moved = SPEED_PER_VOLT * np.concatenate([[0.0], np.cumsum(data[:-1, 11])]) / 1000.0
    assert data[:, 5] - data[0, 5] == pytest.approx(moved, abs=80e-3 / 65535)
    assert [block.tick - tick for block in blocks] == list(range(0, 750, 10))
    assert not any(block.tripped for block in blocks)


def test_a_second_apply_keeps_the_phase_unless_told_to_restart(driver: ModbusTcpDriver) -> None:
    driver.upload(0, np.linspace(-1.0, 1.0, 1000))
    driver.start()
    driver.apply([OutputLaw(gain=1.0, limit=4.0), OFF], restart=True)
    before = read(driver, 10)[:, 10]
    driver.apply([OutputLaw(gain=2.0, limit=4.0), OFF])
    after = read(driver, 10)[:, 10]
    driver.apply([OutputLaw(gain=2.0, limit=4.0), OFF], restart=True)
    again = read(driver, 1)[:, 10]
    step = 10 / 2047
    assert before[-1] == pytest.approx(-1.0 + 2.0 * 99 / 999, abs=step)
    assert after[0] == pytest.approx(2 * (-1.0 + 2.0 * 100 / 999), abs=step)
    assert again[0] == pytest.approx(-2.0, abs=step)


def test_the_position_law_pulls_the_piston_to_its_setpoint(driver: ModbusTcpDriver) -> None:
    driver.start()
    driver.apply([OutputLaw(position_gain=400.0, setpoint=0.01, limit=3.0), OFF])
    data = read(driver, 150)
    # Closed loop: ds/dt = 0.02 * 400 (r - s) has a time constant of 1/8 s.
    assert data[-1, 1] == pytest.approx(0.01, abs=20e-6)
    assert data[:, 10].max() <= 3.0


def test_samples_are_decoded_with_the_rigs_sensors(driver: ModbusTcpDriver) -> None:
    rig = seed_rig()
    driver.start()
    block = driver.read_block()
    for column, name in enumerate(rig.channels[:8]):
        value = 2.0e6 if "pressure" in name else block.data[0, column]
        sensor = rig.sensors.of(name[:-2])
        code = round((value - sensor.range[0]) / (sensor.range[1] - sensor.range[0]) * 65535)
        assert block.data[0, column] == decode_input(code, *sensor.range, 16)
    # The plant's temperature register counts samples, so code 0 would be saturated.
    count = block.data[:, 9] * 65535 / 100.0
    assert count == pytest.approx((block.tick + np.arange(10)) & 0xFFFF, abs=1e-6)
    assert block.data.shape == (10, 12)
    assert block.saturated.shape == (10, 10)
    assert not block.saturated[:, :9].any()


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


def changed(rig: Rig, **update: object) -> Rig:
    return rig.model_copy(update=update)


def wider_pressure(rig: Rig) -> Rig:
    sensor = rig.sensors.chamber_pressure.model_copy(update={"range": (-1e5, 2e7)})
    return changed(rig, sensors=rig.sensors.model_copy(update={"chamber_pressure": sensor}))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda r: changed(r, joints=r.joints[:1]), "joints 2, expected 1"),
        (
            lambda r: changed(r, sensors=r.sensors.model_copy(update={"oil_temperature": None})),
            "channels 10, expected 9",
        ),
        (lambda r: changed(r, sample_rate=2000.0), r"sample rate \[Hz\] 1000, expected 2000"),
        (lambda r: changed(r, name="other-bench"), "rig 'shinshu-2dof', expected 'other-bench'"),
        (wider_pressure, "other ranges or bits"),
    ],
)
def test_a_device_of_another_rig_is_refused(
    port: int, make: Callable[[Rig], Rig], says: str
) -> None:
    rig = make(seed_rig(port=port))
    with pytest.raises(DeviceError, match=says):
        ModbusTcpDriver(rig.wire, rig).connect()


@pytest.mark.parametrize(
    ("law", "says"),
    [
        (OutputLaw(bias=float("nan"), limit=1.0), "not finite"),
        (OutputLaw(gain=float("inf"), limit=1.0), "not finite"),
        (OutputLaw(limit=10.1), "out of range"),
        (OutputLaw(limit=-1.0), "out of range"),
        (OutputLaw(setpoint=0.05, limit=1.0), "out of range"),
        (OutputLaw(gain=1e39), "not finite"),
    ],
)
def test_an_impossible_law_is_refused_and_changes_nothing(
    driver: ModbusTcpDriver, law: OutputLaw, says: str
) -> None:
    driver.start()
    good = OutputLaw(bias=0.5, limit=1.0)
    driver.apply([OFF, good])
    with pytest.raises(DeviceError, match=rf"joint 2\): a value is {says}"):
        driver.apply([OFF, law])
    assert read(driver, 1)[-1, 11] == pytest.approx(0.5, abs=0.01)


def test_a_waveform_that_cannot_be_put_out_is_refused(driver: ModbusTcpDriver) -> None:
    wave = np.zeros(100)
    wave[37] = 10.5
    with pytest.raises(DeviceError, match=r"joint 1: sample 37 is 10.5 V.*\+-10 V"):
        driver.upload(0, wave)
    wave[37] = np.nan
    with pytest.raises(DeviceError, match="sample 37"):
        driver.upload(0, wave)
    for size in (0, 131_073):
        with pytest.raises(DeviceError, match="1 to 131072"):
            driver.upload(0, np.zeros(size))
    with pytest.raises(DeviceError, match="no joint 3"):
        driver.upload(2, np.zeros(3))


def test_zero_outputs_acts_between_two_blocks(driver: ModbusTcpDriver) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    assert read(driver, 1)[:, 10].min() > 0.9
    driver.zero_outputs()
    assert np.all(read(driver, 1)[:, 10:] == 0.0)


def test_reading_without_a_stream_says_so(driver: ModbusTcpDriver) -> None:
    with pytest.raises(DeviceError, match="does not stream"):
        driver.read_block()


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
