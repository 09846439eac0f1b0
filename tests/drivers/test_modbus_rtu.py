"""A host meets a device on a serial line: its own process at the far end of a pseudo-terminal."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import numpy as np
import pytest
from serial import SerialException

from drivers import make_driver, wire_at
from drivers.base import OFF, DeviceBusy, DeviceError, DeviceLost, OutputLaw
from drivers.modbus_rtu import ModbusRtuDriver
from hil_sim.device.rtu_server import checksum, checksum_matches, frame_length
from rig.model.parse import InputError
from tests.drivers.wires import BadLine, device_at
from tests.hil_sim.integrator import SPEED_PER_VOLT, seed_rig

TIMEOUT = 0.4


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with device_at("virtual", "modbus-rtu") as (_, endpoint):
        yield endpoint


@pytest.fixture
def line(endpoint: str) -> Iterator[BadLine]:
    line = BadLine(endpoint.removeprefix("modbus-rtu://"))
    yield line
    line.close()


@pytest.fixture
def driver(line: BadLine) -> Iterator[ModbusRtuDriver]:
    rig = seed_rig(timeout=TIMEOUT)
    driver = make_driver(wire_at(f"modbus-rtu://{line.path}", rig.wire), rig)
    assert isinstance(driver, ModbusRtuDriver)
    driver.connect()
    driver.reset()
    yield driver
    driver.close()


def test_checksums_are_those_of_the_standard() -> None:
    # Modbus over Serial Line V1.02, and the CRC catalogue's check value of "123456789".
    assert checksum(bytes.fromhex("010300000001")) == bytes.fromhex("840a")
    assert checksum(b"123456789") == bytes.fromhex("374b")
    assert checksum_matches(bytes.fromhex("010300000001840a"))
    assert not checksum_matches(bytes.fromhex("010300000101840a"))


def test_a_request_is_as_long_as_its_function_says() -> None:
    assert frame_length(bytes.fromhex("0103")) == 8
    assert frame_length(bytes.fromhex("01100080000204")) == 13
    assert frame_length(bytes.fromhex("0110008000")) is None
    assert frame_length(bytes.fromhex("0117010000050080000204")) == 17


def test_a_device_on_a_serial_line_plays_an_uploaded_waveform(driver: ModbusRtuDriver) -> None:
    assert driver.info is not None
    assert driver.info.identity == "shinshu-2dof"
    driver.upload(1, 3.0 * np.sin(2 * np.pi * np.arange(250) / 250))
    driver.start()
    driver.read_block()
    tick = driver.apply([OFF, OutputLaw(gain=0.5, bias=0.25, limit=1.5)], restart=True)
    blocks = [driver.read_block() for _ in range(50)]
    data = np.vstack([block.data for block in blocks])
    assert [block.tick - tick for block in blocks] == list(range(0, 500, 10))
    moved = SPEED_PER_VOLT * np.concatenate([[0.0], np.cumsum(data[:-1, 11])]) / 1000.0
    assert data[:, 5] - data[0, 5] == pytest.approx(moved, abs=80e-3 / 65535)
    driver.zero_outputs()
    assert np.all(driver.read_block().data[:, 10:] == 0.0)


@pytest.mark.parametrize("fault", ["lose one", "late", "flip", "split", "twice"])
def test_whatever_one_answer_suffers_no_sample_is_wrong_or_missing(
    driver: ModbusRtuDriver, line: BadLine, fault: str
) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
    first = driver.read_block()
    line.fault = fault
    blocks = [first]
    try:
        blocks += [driver.read_block() for _ in range(6)]
    except DeviceError:
        # A damaged answer may end the session: said, never silently taken as samples.
        assert fault == "flip"
    assert line.fault == "pass"
    assert [b.tick - first.tick for b in blocks] == [10 * k for k in range(len(blocks))]
    data = np.vstack([b.data for b in blocks])
    moved = SPEED_PER_VOLT * np.concatenate([[0.0], np.cumsum(data[:-1, 10])]) / 1000.0
    assert data[:, 1] - data[0, 1] == pytest.approx(moved, abs=80e-3 / 65535)
    driver.zero_outputs()


def test_a_line_that_falls_silent_is_a_lost_device_in_bounded_time(
    driver: ModbusRtuDriver, line: BadLine
) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    line.fault = "silent"
    with pytest.raises(DeviceLost, match=r"has not answered for 0.4 s"):
        driver.read_block()
    line.fault = "pass"
    driver.zero_outputs()


def test_a_missing_port_and_a_wrong_key_say_what_to_change() -> None:
    rig = seed_rig(timeout=TIMEOUT)
    absent = make_driver(wire_at("modbus-rtu:///dev/no-such-port?baud=115200", rig.wire), rig)
    with pytest.raises(DeviceLost, match="no-such-port"):
        absent.connect()
    with pytest.raises(InputError, match=r"wire: baud: .*found 'fast'"):
        make_driver(wire_at("modbus-rtu:///dev/x?baud=fast", rig.wire), rig)
    with pytest.raises(InputError, match=r"expected one like modbus-rtu:///dev/ttyUSB0\?baud"):
        wire_at("modbus-rtu:", rig.wire)
    with pytest.raises(InputError, match=r"expected KIND://.*modbus-rtu modbus-tcp"):
        wire_at("carrier-pigeon://loft", rig.wire)
    with pytest.raises(InputError, match="'carrier-pigeon' has no driver; installed:"):
        make_driver(rig.wire.reached_by("carrier-pigeon", {}), rig)
    with pytest.raises(InputError, match="wire: prot: unknown key of wire modbus-tcp; expected"):
        make_driver(rig.wire.reached_by("modbus-tcp", {"prot": 502}), rig)
    with pytest.raises(InputError, match="wire: port: expected a number, found true or false"):
        make_driver(rig.wire.reached_by("modbus-tcp", {"port": True}), rig)


def test_after_a_late_answer_the_next_request_gets_its_own(
    driver: ModbusRtuDriver, line: BadLine
) -> None:
    driver.start()
    driver.read_block()
    line.fault = "late"
    driver.read_block()
    driver.upload(1, np.zeros(7))


def to_port(device: str) -> ModbusRtuDriver:
    rig = seed_rig(timeout=TIMEOUT)
    driver = make_driver(wire_at(f"modbus-rtu://{device}", rig.wire), rig)
    assert isinstance(driver, ModbusRtuDriver)
    return driver


def test_a_port_that_cannot_be_opened_is_named_with_the_reason(endpoint: str) -> None:
    with pytest.raises(DeviceLost, match="there is no port /dev/nothing-here"):
        to_port("/dev/nothing-here").connect()
    with pytest.raises(DeviceError, match="is no serial port; expected one such as"):
        to_port(__file__).connect()
    taken = to_port(endpoint.removeprefix("modbus-rtu://"))
    taken.connect()
    try:
        with pytest.raises(DeviceBusy, match="in use by another program, which has control"):
            to_port(endpoint.removeprefix("modbus-rtu://")).connect()
    finally:
        taken.close()


def test_a_port_that_may_not_be_opened_says_who_may(monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object, **__: object) -> None:
        raise SerialException(errno.EACCES, "could not open port /dev/ttyUSB0: Permission denied")

    monkeypatch.setattr("serial.Serial", denied)
    with pytest.raises(DeviceError, match=r"no permission to open /dev/ttyUSB0; .*dialout"):
        to_port("/dev/ttyUSB0").connect()
