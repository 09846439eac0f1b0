"""A host meets a device over a serial line: in its own process, and over lines that misbehave."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest

from drivers.base import OFF, DeviceBusy, DeviceError, DeviceLost, OutputLaw
from drivers.serial_stream import SerialSettings, SerialStreamDriver
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FrameDecoder, WireFrame, encode_frame
from rig.model.wire.registers import TripCause
from rig.model.wire.serial_messages import Message
from tests.drivers.driving_host import driving_host
from tests.drivers.firmware import firmware_command
from tests.drivers.serial_lines import BadLine, Loop, port_of, simulator_command
from tests.drivers.streamed_device import StreamedDevice, read
from tests.hil_sim.integrator import expected_outputs, seed_rig

TIMEOUT = 0.4
PATIENCE = 30.0  # a loaded machine may take long; the assertions do not depend on it
COMMANDS = {"simulator": simulator_command, "firmware": firmware_command}
DRIVING = [OutputLaw(bias=1.0, limit=2.0), OFF]


@pytest.fixture(scope="module", params=COMMANDS)
def command(request: pytest.FixtureRequest) -> Callable[[str], list[str]]:
    return COMMANDS[request.param]


@pytest.fixture(scope="module")
def port(command: Callable[[str], list[str]]) -> Iterator[str]:
    with port_of(command("virtual")) as (_, port):
        yield port


def host(port: str, **wire: float) -> SerialStreamDriver:
    return SerialStreamDriver(Wire(kind="serial", device=port, **wire), seed_rig())


@pytest.fixture
def driver(port: str) -> Iterator[SerialStreamDriver]:
    driver = host(port)
    driver.connect()
    driver.reset()
    yield driver
    driver.close()


@pytest.fixture
def line(port: str) -> Iterator[BadLine]:
    line = BadLine(port)
    yield line
    line.close()


def over(line: BadLine) -> SerialStreamDriver:
    driver = host(line.port, timeout=TIMEOUT)
    end = time.monotonic() + PATIENCE
    while True:
        try:
            driver.connect()
            break
        except DeviceBusy:  # the device has not noticed yet that the line of the test before ended
            assert time.monotonic() < end
            time.sleep(0.05)
    driver._link.extend_timeout(1.0)
    driver.reset()
    return driver


# -- what every device on a serial line must do ---------------------------------------------


@pytest.fixture
def made_for(port: str) -> Callable[[Rig], SerialStreamDriver]:
    return lambda rig: SerialStreamDriver(Wire(kind="serial", device=port), rig)


class TestSerialDevice(StreamedDevice):
    """The tests that this wire has in common with others."""


def test_a_long_waveform_crosses_the_line_whole(driver: SerialStreamDriver) -> None:
    wave = np.random.default_rng(7).uniform(-2.0, 2.0, 30_000)
    driver.upload(0, wave)
    driver.start()
    driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    played = read(driver, 3_001)[:, 10]
    # Rounded twice, to 16 bits when stored and to 12 when put out: at most one step apart.
    wanted = expected_outputs(np.append(wave, wave[:10]), seed_rig())
    assert played == pytest.approx(wanted, abs=1.001 * 10 / 2047)


def test_a_torn_upload_leaves_the_waveform_before(driver: SerialStreamDriver) -> None:
    driver.upload(0, np.full(3, 1.0))
    driver.start()
    law = OutputLaw(gain=1.0, limit=4.0)
    driver.apply([law, OFF], restart=True)
    link = driver._link
    for end in (0, reg.wave_checksum(np.zeros(3, np.int16))):  # wrong checksum; a page missing
        link.request(Message.UPLOAD_BEGIN, msg.pack_upload_begin(1, 4))
        pages = 4 if end == 0 else 3
        link.request(Message.UPLOAD_PAGE, msg.pack_u32(0) + bytes(2 * pages))
        with pytest.raises(DeviceError, match="incomplete or its checksum differs"):
            link.request(Message.UPLOAD_END, msg.pack_u32(end))
    with pytest.raises(DeviceError, match="incomplete"):
        link.request(Message.UPLOAD_PAGE, msg.pack_u32(0) + bytes(2))
    driver.apply([law, OFF])
    assert read(driver, 1)[:, 10] == pytest.approx(1.0, abs=0.01)


def test_a_second_host_cannot_take_over_but_can_make_it_safe(
    driver: SerialStreamDriver, port: str
) -> None:
    driver.start()
    driver.apply(DRIVING)
    other = host(port)
    with pytest.raises(DeviceError, match="in use by another program, which has control"):
        other.connect()
    assert read(driver, 1)[:, 10].min() > 0.9
    other.zero_outputs()
    assert np.all(read(driver, 2)[-10:, 10:] == 0.0)
    other.close()
    assert driver.trip_cause() is None


@pytest.mark.parametrize(
    ("kind", "payload", "says"),
    [
        (0x7E, b"", "knows no such request"),
        (Message.START, b"\0", "not of this size"),
        (Message.APPLY, bytes(4), "not of this size"),
        (Message.APPLY, bytes(42), "out of range"),
        (Message.RESET, b"\0\1", "out of range"),
        (Message.OPEN, b"\0\1", "out of range"),
        (Message.UPLOAD_BEGIN, bytes(6), "out of range"),
        (Message.UPLOAD_END, bytes(4), "incomplete"),
    ],
)
def test_a_bad_request_is_refused_with_its_reason(
    driver: SerialStreamDriver, kind: int, payload: bytes, says: str
) -> None:
    frame = WireFrame(kind, driver._link.next_number(), driver._link._session, payload)
    answer = bytes_answered(driver, frame)
    assert (answer.type, answer.number, answer.session) == (
        Message.REFUSED,
        frame.number,
        frame.session,
    )
    with pytest.raises(DeviceError, match=says):
        raise driver._link._refused(answer.payload, "it")


def test_another_version_is_named(driver: SerialStreamDriver) -> None:
    frame = WireFrame(Message.IDENTIFY, 1, 7, b"", version=2)
    answer = bytes_answered(driver, frame)
    assert (answer.type, answer.version, answer.session) == (Message.REFUSED, 1, 7)


def bytes_answered(driver: SerialStreamDriver, frame: WireFrame) -> WireFrame:
    """Send a frame past the driver, return what the device answers to it."""
    transport, decoder = driver._link._line.transport, FrameDecoder()
    transport.write(encode_frame(frame))
    if frame.session == driver._link._session:
        driver._link._number = frame.number
    for _ in range(100):
        for answer in decoder.feed(transport.read(0.1)):
            if answer.number == frame.number and answer.session == frame.session:
                return answer
    raise AssertionError("no answer")


def test_a_request_that_comes_twice_is_carried_out_once(driver: SerialStreamDriver) -> None:
    driver.start()
    link = driver._link
    driver.apply(DRIVING)
    apply = WireFrame(
        Message.APPLY,
        link._number,
        link._session,
        msg.pack_apply(1, [[0.0, 1.0, 0.0, 0.0, 2.0]] * 2),
    )
    first = bytes_answered(driver, apply)
    read(driver, 3)
    assert bytes_answered(driver, apply) == first
    assert first.type == Message.APPLY | msg.ANSWER
    driver.zero_outputs()
    # The same bytes once more, late: after a newer request they do nothing and get no answer.
    link._line.transport.write(encode_frame(apply))
    assert np.all(read(driver, 3)[:, 10:] == 0.0)


def test_another_session_is_refused_what_needs_control(driver: SerialStreamDriver) -> None:
    session = driver._link._session ^ 1
    for kind, payload in (
        (Message.START, b""),
        (Message.APPLY, msg.pack_apply(1, [[0.0] * 5] * 2)),
        (Message.CLOSE, b""),
        (Message.RESET, b"RS"),
    ):
        answer = bytes_answered(driver, WireFrame(kind, 40_000, session, payload))
        assert answer.type == Message.REFUSED
        assert msg.unpack_refusal(answer.payload).reason == reg.Refusal.NOT_IN_CONTROL
    opened = bytes_answered(driver, WireFrame(Message.OPEN, 40_001, session, b"\x01\x00"))
    assert msg.unpack_refusal(opened.payload).reason == reg.Refusal.NOT_IN_CONTROL


def test_noise_and_nonsense_leave_a_device_that_answers(port: str) -> None:
    driver = host(port)
    driver.connect()
    transport, rng = driver._link._line.transport, random.Random(3)
    sizes = {Message.APPLY: 42, Message.RESET: 2, Message.OPEN: 2, Message.UPLOAD_BEGIN: 6}
    for number in range(2_000):
        kind = rng.choice([*Message, rng.randrange(256)])
        size = sizes.get(kind, 0) if rng.random() < 0.7 else rng.randrange(253)
        payload = rng.randbytes(size) if rng.random() < 0.7 else bytes(size)
        session = driver._link._session if rng.random() < 0.8 else rng.getrandbits(32)
        wire = bytearray(encode_frame(WireFrame(kind, number + 10, session, payload)))
        if rng.random() < 0.3:
            wire[rng.randrange(len(wire))] ^= 1 << rng.randrange(8)
        if rng.random() < 0.1:
            wire += rng.randbytes(rng.randrange(600))
        transport.write(bytes(wire))
        transport.read(0.0)
    driver._link._number = 3_000
    driver.close()
    driver = connected_soon(port)
    driver.reset()
    driver.start()
    assert read(driver, 3).shape == (30, 12)
    driver.close()


def test_closing_after_a_trip_leaves_one_in_the_device(port: str) -> None:
    driver = host(port)
    driver.connect()
    driver.reset()
    driver.start()
    driver.apply(DRIVING)
    driver.read_block()
    driver.close_tripped()
    after = connected_soon(port)
    assert "connection ended" in (after.trip_cause() or "")
    after.reset()
    after.close()


def test_a_host_that_vanished_leaves_a_trip_that_only_a_reset_clears(port: str) -> None:
    gone = host(port)
    gone.connect()
    gone.reset()
    gone.start()
    gone.apply(DRIVING)
    gone.read_block()
    gone._link.close()  # as when its process dies: no goodbye

    driver = connected_soon(port)
    assert "connection ended" in (driver.trip_cause() or "")
    driver.start()
    assert driver.read_block().tripped
    with pytest.raises(DeviceError, match=r"connection ended.*reset"):
        driver.apply(DRIVING)
    driver.apply([OFF, OFF])  # what keeps the outputs at zero is always allowed
    driver.reset()
    driver.apply(DRIVING)
    block = driver.read_block()
    assert not block.tripped
    assert block.data[:, 10].min() > 0.9
    driver.close()


def connected_soon(port: str, **wire: float) -> SerialStreamDriver:
    """Connect once the device has noticed the end of the host before."""
    driver = host(port, **wire)
    end = time.monotonic() + PATIENCE
    while True:
        try:
            driver.connect()
        except DeviceError as error:
            if "another client has control" not in str(error) or time.monotonic() > end:
                raise
            time.sleep(0.02)
        else:
            return driver


# -- the end of a host, in real time --------------------------------------------------------


@pytest.mark.parametrize(
    ("sign", "watchdog", "cause"),
    [(signal.SIGKILL, 10.0, TripCause.HOST_LOST), (signal.SIGSTOP, 0.3, TripCause.WATCHDOG)],
)
def test_a_host_that_ends_or_stands_still_leaves_outputs_at_zero(
    command: Callable[[str], list[str]], sign: signal.Signals, watchdog: float, cause: TripCause
) -> None:
    with (
        port_of(command("realtime")) as (_, port),
        driving_host("serial", "device", port, watchdog) as driving,
    ):
        os.kill(driving.pid, sign)
        if sign == signal.SIGKILL:
            driving.wait(PATIENCE)
            time.sleep(0.3)  # a port opened again at once would hide that it was closed
        try:
            status = status_once_tripped(port)
        finally:
            driving.kill()
            driving.wait(PATIENCE)
    flags, found = int.from_bytes(status[:2], "big"), int.from_bytes(status[2:4], "big")
    assert flags & reg.Status.TRIPPED
    assert found in (cause, TripCause.WATCHDOG)
    assert status[-18:] == bytes(18)


def status_once_tripped(port: str) -> bytes:
    """Ask without control, as a bystander on the same port, until a tick after the trip."""
    watcher = host(port, timeout=PATIENCE)
    watcher._link.open(shared=True)
    end = time.monotonic() + PATIENCE
    while True:
        status = watcher._status()
        tripped, tick = (int.from_bytes(status[at : at + 4], "big") for at in (4, 8))
        if int.from_bytes(status[2:4], "big") and tick > tripped:
            watcher._link.close()
            return status
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_slow_host_loses_nothing(command: Callable[[str], list[str]]) -> None:
    with port_of(command("realtime")) as (_, port):
        driver = host(port, timeout=PATIENCE, watchdog=5.0)
        driver.connect()
        driver.start()
        first = driver.read_block()
        time.sleep(1.0)  # more than a window, less than the device keeps
        ticks = [driver.read_block().tick for _ in range(150)]
        driver.close()
    assert ticks == [first.tick + 10 * k for k in range(1, 151)]


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT])
def test_a_device_that_ends_is_a_lost_device(
    command: Callable[[str], list[str]], sign: signal.Signals
) -> None:
    with port_of(command("realtime")) as (process, port):
        driver = host(port)
        driver.connect()
        driver.start()
        driver.read_block()
        process.send_signal(sign)
        assert process.wait(PATIENCE) == 0
        with pytest.raises(DeviceLost, match="gone"):
            read(driver, 1000)
        with pytest.raises(DeviceLost, match="no port"):
            driver.zero_outputs()
        driver.close()


# -- lines that misbehave -------------------------------------------------------------------


def test_a_lost_answer_is_asked_for_again_and_no_sample_is_missing(line: BadLine) -> None:
    driver = over(line)
    driver.start()
    first = driver.read_block()
    line.fault = "lose one"
    second = driver.read_block()
    third = driver.read_block()
    line.fault = "lose one"
    assert driver.trip_cause() is None
    assert line.fault == "pass"
    assert [b.tick - first.tick for b in (second, third)] == [10, 20]
    assert [b.sequence for b in (first, second, third)] == [0, 1, 2]
    driver.close()


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("silent", "has not answered for 0.4 s"),
        ("garbage", "has not answered for 0.4 s"),
        ("unplugged", "has gone"),
    ],
)
def test_a_line_that_fails_mid_run_is_named_in_time(line: BadLine, fault: str, says: str) -> None:
    driver = over(line)
    driver.start()
    driver.apply(DRIVING)
    driver.read_block()
    line.fault = fault
    began = time.monotonic()
    with pytest.raises(DeviceLost, match=says):
        read(driver, 1000)
    assert time.monotonic() - began < 2 * TIMEOUT + 5.0
    if fault == "unplugged":
        with pytest.raises(DeviceLost):
            driver.zero_outputs()
    else:
        # Zeroing tries anew, over a line that has recovered; on a busy machine more than once.
        line.fault = "pass"
        deadline = time.monotonic() + 60.0
        while True:
            try:
                driver.zero_outputs()
                break
            except DeviceLost:
                assert time.monotonic() < deadline
    driver.close()


@pytest.mark.parametrize("fault", ["silent", "garbage", "unplugged"])
def test_zeroing_over_a_dead_line_ends_in_time_and_closing_never_raises(
    line: BadLine, fault: str
) -> None:
    driver = over(line)
    line.fault = fault
    if fault == "unplugged":
        line._thread.join(5)
    began = time.monotonic()
    with pytest.raises(DeviceError):
        driver.zero_outputs()
    driver.close()
    assert time.monotonic() - began < 3 * TIMEOUT + 5.0


def test_a_line_with_another_baud_rate_says_what_to_check(line: BadLine) -> None:
    line.fault = "garbage"
    with pytest.raises(DeviceLost, match=r"921600 baud.*no valid frame in \d+ bytes: check `baud`"):
        host(line.port, timeout=TIMEOUT).connect()
    line.fault = "silent"
    with pytest.raises(DeviceLost, match=r"nothing answers at .*bramah sim"):
        host(line.port, timeout=TIMEOUT).connect()


def test_an_endpoint_names_port_and_speed() -> None:
    for endpoint, settings in {
        "serial:///dev/ttyUSB0": {"device": "/dev/ttyUSB0"},
        "serial:///dev/ttyUSB0?baud=460800": {"device": "/dev/ttyUSB0", "baud": "460800"},
        "serial://COM3": {"device": "COM3"},
    }.items():
        assert SerialSettings.of_endpoint(urlsplit(endpoint)) == settings
    with pytest.raises(ValueError, match="no device"):
        SerialSettings.of_endpoint(urlsplit("serial://"))


# -- without a device -----------------------------------------------------------------------


def test_a_port_that_is_none_is_a_lost_device() -> None:
    with pytest.raises(DeviceLost, match=r"no port /dev/nothing-here.*bramah sim"):
        host("/dev/nothing-here").connect()


def test_a_file_is_no_port() -> None:
    with pytest.raises(DeviceError, match=r"is no serial port; expected one such as /dev/ttyUSB0"):
        host(__file__).connect()


def test_a_line_too_slow_for_the_stream_is_refused_before_anything_is_opened() -> None:
    with pytest.raises(DeviceError, match=r"115200 baud .* cannot carry 12 values at 1000 Hz; 268"):
        host("/dev/nothing-here", baud=115_200).connect()


# -- a device in this process, a clock in hand ----------------------------------------------


def looped(loop: Loop) -> SerialStreamDriver:
    wire = Wire(kind="serial", device="loop", timeout=1.0, watchdog=0.5)
    return SerialStreamDriver(wire, seed_rig(), transport=loop, clock=loop.clock)


def test_a_late_answer_never_passes_for_the_present_one() -> None:
    loop = Loop(realtime=True)
    driver = looped(loop)
    driver.connect()
    before = driver._status()
    # The same request again, its answers held back until the next one is under way.
    held: list[bytes] = []
    passing, loop.back.pass_on = loop.back.pass_on, lambda data: held.append(data) or []
    with pytest.raises(DeviceLost, match="has not answered for 1 s"):
        driver.trip_cause()
    assert len(held) == 5
    loop.back.pass_on = lambda data: [*held, *passing(data)]
    status = driver._status()
    assert status[8:12] > before[8:12]
    assert int.from_bytes(status[8:12], "big") == loop.device.tick
    assert driver._link.late >= 5


def test_blocks_of_the_stream_before_are_not_taken_for_the_new_one() -> None:
    loop = Loop(realtime=True)
    driver = looped(loop)
    driver.connect()
    driver.start()
    driver.read_block()
    loop.now += 0.05
    loop.device.poll()
    stale = loop.session.push()
    assert stale
    driver.start()
    loop._arrived.appendleft(stale)
    first = driver.read_block()
    assert first.sequence == 0
    assert first.tick >= 60
    assert driver._link.late == 1


def test_blocks_dropped_in_the_device_show_as_a_gap(caplog: pytest.LogCaptureFixture) -> None:
    loop = Loop(realtime=True)
    driver = looped(loop)
    driver.connect()
    driver.start()
    first = driver.read_block()
    for _ in range(1000):  # ten seconds; the device keeps four
        loop.now += 0.01
        loop.device.poll()
    blocks = [driver.read_block() for _ in range(300)]
    gaps = [b.tick - a.tick for a, b in zip([first, *blocks], blocks, strict=False)]
    assert set(gaps) - {10}
    assert all(gap % 10 == 0 and gap > 0 for gap in gaps)
    assert "dropped" in caplog.text


@pytest.mark.parametrize("realtime", [False, True], ids=["virtual", "realtime"])
@pytest.mark.parametrize("seed", range(4))
def test_faults_on_the_line_cost_no_sample_and_leave_no_output_on(
    seed: int, realtime: bool
) -> None:
    loop = Loop(realtime=realtime, seed=10 * seed, share=0.0)
    driver = looped(loop)
    driver.connect()
    driver.upload(0, np.linspace(-1.0, 1.0, 300))
    driver.start()
    loop.forth.share = loop.back.share = 0.15
    blocks, errors = [], []
    for index in range(600):
        try:
            if index % 40 == 20:
                law = OutputLaw(gain=1.0, limit=float(index % 3))
                driver.apply([law, OFF], restart=index % 80 == 20)
            blocks.append(driver.read_block())
        except DeviceError as error:  # rare: five tries lost in a row
            errors.append(error)
            break
    assert all(isinstance(error, DeviceLost) for error in errors)
    assert errors or len(blocks) == 600
    ticks = [block.tick for block in blocks]
    assert ticks == [ticks[0] + 10 * k for k in range(len(ticks))]
    assert [block.sequence for block in blocks] == list(range(len(blocks)))
    loop.forth.share = loop.back.share = 0.0
    loop.is_open = True
    driver.zero_outputs()
    assert not loop.device.laws.armed
    assert np.all(loop.device.outputs == 0)
    faults = sum(loop.forth.count.values()) + sum(loop.back.count.values())
    assert faults > 50
