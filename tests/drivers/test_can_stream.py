"""A host meets a bench on a CAN bus: in its own process, among other nodes, on buses that fail."""

from __future__ import annotations

import errno
import os
import select
import signal
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import can
import numpy as np
import pytest

from drivers.base import OFF, DeviceBusy, DeviceError, DeviceLost, OutputLaw
from drivers.can_port import BusPlace, CanPort
from drivers.can_stream import CanSettings, CanStreamDriver
from drivers.registry import make_driver, wire_at
from drivers.settings import DRIVER
from hil_sim.device.can.adapters import SocketcandServer
from hil_sim.device.can.server import CanSession, layout_of
from hil_sim.device.device import Device
from hil_sim.device.lifetime import serve_session
from rig.cli.main import run as command
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire.can_frames import CanFrame, zero_frame
from rig.model.wire.can_layout import CanLayout, read_layout
from rig.model.wire.registers import TripCause
from tests.drivers.bus_node import BusNode
from tests.drivers.driving_host import driving_host
from tests.drivers.streamed_device import read
from tests.drivers.test_can_frames import own_database
from tests.drivers.wires import device_at
from tests.hil_sim.integrator import IntegratorPlant, expected_outputs, seed_rig

PATIENCE = 30.0  # a loaded machine may take long; the assertions do not depend on it
DRIVING = [OutputLaw(bias=1.0, limit=2.0), OFF]


def host(endpoint: str, **times: float) -> CanStreamDriver:
    rig = seed_rig(**times)
    driver = make_driver(wire_at(endpoint, rig.wire), rig)
    assert isinstance(driver, CanStreamDriver)
    return driver


@pytest.fixture(scope="module", params=["can", "can-slcan"])
def endpoint(request: pytest.FixtureRequest) -> Iterator[str]:
    with device_at("virtual", request.param) as (_, at):
        yield at


@pytest.fixture(scope="module")
def bus() -> Iterator[str]:
    with device_at("virtual", "can") as (_, at):
        yield at


# -- in a process of its own ----------------------------------------------------------------


def test_a_waveform_crosses_the_bus_and_is_played(endpoint: str) -> None:
    driver = host(endpoint)
    info = driver.connect()
    assert (info.identity, info.joints, info.channels) == ("shinshu-2dof", 2, 10)
    driver.reset()
    wave = np.random.default_rng(7).uniform(-2.0, 2.0, 1_000)
    driver.upload(0, wave)
    driver.start()
    driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    played = read(driver, 101)
    driver.close()
    # Rounded twice, to 16 bits when stored and to 12 when put out: at most one step apart.
    wanted = expected_outputs(np.append(wave, wave[:10]), seed_rig())
    assert played[:, 10] == pytest.approx(wanted, abs=1.001 * 10 / 2047)
    assert np.all(played[:, 11] == 0.0)


def test_a_second_program_may_make_the_bench_safe_and_no_more(bus: str) -> None:
    driver, other = host(bus), host(bus)
    driver.connect()
    driver.reset()
    driver.start()
    driver.apply(DRIVING)
    assert read(driver, 1)[:, 10].min() > 0.9
    with pytest.raises(DeviceBusy, match="another client has control"):
        other.connect()
    assert read(driver, 1)[:, 10].min() > 0.9
    other.zero_outputs()
    assert np.all(read(driver, 9)[-10:, 10:] == 0.0)  # a window may have been on its way
    other.close()
    driver.close()


def test_one_frame_from_any_node_zeroes_the_outputs(bus: str) -> None:
    driver = host(bus)
    driver.connect()
    driver.reset()
    driver.start()
    driver.apply(DRIVING)
    assert read(driver, 1)[:, 10].min() > 0.9
    place = BusPlace.of(bus.removeprefix("can://"))
    with can.Bus(
        interface="socketcand", channel=place.channel, host=place.host, port=place.port
    ) as button:
        frame = zero_frame(layout_of(seed_rig()))
        button.send(can.Message(arbitration_id=frame.identifier, data=b"", is_extended_id=False))
        end = time.monotonic() + PATIENCE
        while read(driver, 1)[:, 10:].any():
            assert time.monotonic() < end
    driver.close()


def test_other_traffic_on_the_bus_changes_nothing(bus: str) -> None:
    driver = host(bus)
    driver.connect()
    driver.reset()
    driver.start()
    place = BusPlace.of(bus.removeprefix("can://"))
    with can.Bus(
        interface="socketcand", channel=place.channel, host=place.host, port=place.port
    ) as other:
        for number in range(300):
            data = number.to_bytes(2, "big")
            wide = number % 2 == 0
            other.send(can.Message(arbitration_id=0x100, data=data, is_extended_id=wide))
            other.send(can.Message(arbitration_id=0x0A0, data=data + b"\0\0", is_extended_id=False))
            if number % 30 == 0:
                read(driver, 1)
    ticks = [driver.read_block().tick for _ in range(20)]
    assert np.diff(ticks) == pytest.approx(10)
    assert driver._link._line._port.counts.foreign >= 100  # type: ignore[attr-defined]
    driver.close()


@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGSTOP])
def test_a_host_that_ends_or_stands_still_leaves_outputs_at_zero(sign: signal.Signals) -> None:
    with device_at("realtime", "can") as (_, at):
        place = at.removeprefix("can://")
        with driving_host("can", "bus", place, 0.3) as driving:
            os.kill(driving.pid, sign)
            watcher = host(at, timeout=PATIENCE)
            watcher._link.open()
            end = time.monotonic() + PATIENCE
            while not int.from_bytes((status := watcher._status())[2:4], "big"):
                assert time.monotonic() < end
                time.sleep(0.02)
            watcher._link.close()
            driving.kill()
            driving.wait(PATIENCE)
    assert int.from_bytes(status[2:4], "big") == TripCause.WATCHDOG
    assert status[-18:] == bytes(18)


def test_a_slow_host_loses_nothing() -> None:
    with device_at("realtime", "can") as (_, at):
        driver = host(at, timeout=PATIENCE, watchdog=5.0)
        driver.connect()
        driver.start()
        first = driver.read_block()
        time.sleep(1.0)  # more than a window, less than the device keeps
        ticks = [driver.read_block().tick for _ in range(150)]
        driver.close()
    assert np.diff([first.tick, *ticks]) == pytest.approx(10)


def test_a_bench_that_ends_is_lost_at_once() -> None:
    with device_at("virtual", "can") as (process, at):
        driver = host(at, timeout=PATIENCE)
        driver.connect()
        driver.start()
        driver.read_block()
        process.kill()
        process.wait(PATIENCE)
        began = time.monotonic()
        with pytest.raises(DeviceLost, match="has gone"):
            read(driver, 1_000)
        assert time.monotonic() - began < PATIENCE
        driver.close()


# -- inside one process ---------------------------------------------------------------------


@contextmanager
def node(rig: Rig, layout: CanLayout, name: str) -> Iterator[str]:
    """The integrator as a node of python-can's virtual bus; gives the endpoint."""
    adapter = BusNode(f"virtual/{name}")
    device, ended = Device(rig, IntegratorPlant(rig), realtime=False), []
    session = CanSession(device, layout)
    thread = threading.Thread(target=serve_session, args=(adapter, session, device, ended))
    thread.start()
    try:
        yield adapter.endpoint
    finally:
        ended.append(1)
        thread.join(PATIENCE)
        adapter.close()


def test_a_fast_rig_runs_with_fd_frames() -> None:
    rig = seed_rig().model_copy(update={"sample_rate": 4000.0})
    with node(rig, layout_of(rig, fd=True), "fd") as at:
        wire = wire_at(f"{at}?data_bitrate=5000000", rig.wire)
        driver = CanStreamDriver(wire, rig)
        driver.connect()
        driver.upload(1, np.full(500, 1.5))
        driver.start()
        driver.apply([OFF, OutputLaw(gain=1.0, limit=2.0)])
        assert read(driver, 20)[-1, 11] == pytest.approx(1.5, abs=0.01)
        driver.close()


def test_a_bench_with_a_file_of_its_own(tmp_path: Path) -> None:
    rig = seed_rig().model_copy(update={"sample_rate": 100.0})
    file = tmp_path / "own.dbc"
    file.write_text(own_database(), "cp1252")
    with node(rig, read_layout(own_database(), "own.dbc", rig), "own") as at:
        driver = CanStreamDriver(wire_at(f"{at}?dbc={file}", rig.wire), rig)
        driver.connect()
        driver.start()
        driver.apply(DRIVING)
        assert read(driver, 20)[-1, 10] == pytest.approx(1.0, abs=0.01)
        driver.close()


# -- what is wrong, said in one line --------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"bus": "socketcan/can0", "bitrate": 500_000}, r"102 % of a bus of 500000 bit/s.*784 Hz"),
        ({"bus": "canbus/can0"}, "no interface 'canbus'; expected INTERFACE/CHANNEL"),
        ({"bus": "socketcan"}, "the channel is missing"),
        ({"bus": "socketcand/localhost/can0"}, "socketcand/HOST:PORT/CHANNEL"),
        ({"bus": "socketcand/localhost:70000/can0"}, "the port 1 to 65535"),
        ({"bus": "socketcand/h:1/can0", "data_bitrate": 2_000_000}, "data_bitrate: socketcand"),
        ({"bus": "slcan/dev/ttyACM0", "data_bitrate": 3_000_000}, "data_bitrate: slcan has"),
        ({"bus": "socketcan/can0", "dbc": "absent.dbc"}, "dbc: absent.dbc: No such file"),
        ({"bus": "socketcan/can0", "baud": 1}, "baud: unknown key of wire can"),
        ({"bitrate": 1_000_000}, "bus: wire can needs it"),
    ],
)
def test_settings_that_cannot_be_are_refused_at_load(
    settings: dict[str, object], says: str
) -> None:
    with pytest.raises(InputError, match=rf"wire: .*{says}") as caught:
        CanStreamDriver(Wire(kind="can", **settings), seed_rig())
    assert "\n" not in str(caught.value)


def test_an_endpoint_names_the_bus_and_comes_back() -> None:
    text = "can://slcan/dev/ttyACM0?bitrate=500000&dbc=/a/b.dbc"
    wire = wire_at(text, seed_rig().wire)
    assert wire.settings == {"bus": "slcan/dev/ttyACM0", "bitrate": "500000", "dbc": "/a/b.dbc"}
    assert wire.endpoint == text
    assert BusPlace.of("slcan/dev/ttyACM0").channel == "/dev/ttyACM0"
    assert BusPlace.of("slcan/COM3").channel == "COM3"
    assert BusPlace.of("socketcand/[::1]:29536/can0").host == "::1"
    assert CanSettings.of_endpoint(urlsplit("can://socketcan/can0")) == {"bus": "socketcan/can0"}


def refusing(error: Exception, bus: str = "socketcan/can0") -> CanPort:
    def make(**_: object) -> None:
        raise error

    return CanPort(BusPlace.of(bus), 500_000, None, frozenset(), make)


@pytest.mark.parametrize(
    ("error", "kind", "says"),
    [
        (PermissionError(errno.EACCES, "denied"), DeviceError, "no permission to open"),
        (OSError(errno.ENODEV, "No such device"), DeviceLost, "there is no socketcan/can0"),
        (
            OSError(errno.ENETDOWN, "down"),
            DeviceLost,
            "ip link set can0 up type can bitrate 500000",
        ),
        (OSError(errno.EAFNOSUPPORT, "x"), DeviceError, "has no SocketCAN"),
        (can.CanInterfaceNotImplementedError("no library"), DeviceError, "cannot be used here"),
        (can.CanInitializationError("what\never"), DeviceLost, "at 500000 bit/s: what ever"),
        (RuntimeError("a vendor's own"), DeviceLost, "a vendor's own"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_what_to_change(
    error: Exception, kind: type[DeviceError], says: str
) -> None:
    with pytest.raises(kind, match=says) as caught:
        refusing(error).open()
    assert "\n" not in str(caught.value)


def test_a_port_that_is_no_socketcand_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def greet() -> None:
            end, _ = server.accept()
            end.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")
            end.close()

        thread = threading.Thread(target=greet)
        thread.start()
        with pytest.raises(DeviceError, match=r"is no socketcand: it said b'SSH-2.0"):
            host(f"can://socketcand/127.0.0.1:{port}/can0").connect()
        thread.join(PATIENCE)
    with pytest.raises(DeviceLost, match=r"nobody listens at 127.0.0.1:.*bramah sim"):
        host(f"can://socketcand/127.0.0.1:{port}/can0").connect()


def test_another_channel_of_a_socketcand_is_refused(bus: str) -> None:
    with pytest.raises(DeviceLost, match="has no bus can7: it said"):
        host(bus.replace("/can0", "/can7")).connect()


def test_a_bus_of_another_rate_stays_silent() -> None:
    rig = seed_rig().model_copy(update={"sample_rate": 100.0})
    with device_at("virtual", "can-slcan") as (_, at):
        wire = wire_at(f"{at}?bitrate=500000", rig.wire).model_copy(update={"timeout": 0.3})
        with pytest.raises(DeviceLost, match=r"nothing answers.*check.*runs at 500000 bit/s"):
            CanStreamDriver(wire, rig).connect()


def test_a_bus_without_a_bench_says_what_was_heard() -> None:
    server = SocketcandServer("127.0.0.1", 0)
    ended: list[int] = []

    def chatter() -> None:
        while not ended:
            server.receive(0.01)
            server.send([CanFrame(0x333, b"\1"), *chatting])

    chatting: list[CanFrame] = []
    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        driver = host(server.endpoint, timeout=0.2)
        with pytest.raises(DeviceLost, match=r"none with an identifier of the DBC made for"):
            driver.connect()
        chatting.append(CanFrame(0x0B0, b"\0\0\x14nonsense"[:8]))
        with pytest.raises(DeviceLost, match=r"none a whole message: another node"):
            driver.connect()
    finally:
        ended.append(1)
        thread.join(PATIENCE)
        server.close()


class FullBus:
    """A bus whose transmit queue is full for a while, or for ever: nobody acknowledges."""

    def __init__(self, times: int) -> None:
        self.left, self.sent = times, 0

    def send(self, _message: can.Message, timeout: float) -> None:
        if self.left:
            self.left -= 1
            raise can.CanOperationError("No buffer space available", errno.ENOBUFS)
        self.sent += 1

    def recv(self, timeout: float) -> None:
        time.sleep(timeout)

    def shutdown(self) -> None:
        """Nothing to do."""


def test_a_full_transmit_queue_is_waited_for_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    full = FullBus(5)
    port = CanPort(BusPlace.of("socketcan/can0"), 500_000, None, frozenset(), lambda **_: full)
    port.open()
    port.send(CanFrame(1, b"\0"))
    assert full.sent == 1
    full.left = 10**9
    monkeypatch.setattr("drivers.can_port.DRIVER", replace(DRIVER, can_send=0.05))
    with pytest.raises(DeviceLost, match=r"no other node acknowledges.*500000 bit/s"):
        port.send(CanFrame(1, b"\0"))
    assert not port.is_open


def test_a_wrong_file_ends_a_verb_with_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "my.dbc"
    file.write_text(own_database().replace(" SG_ piston_2 ", " SG_ piston_9 "), "cp1252")
    with pytest.raises(SystemExit) as ended:
        command(
            ["probe", "--rig", "shinshu-2dof", "--endpoint", f"can://socketcan/can0?dbc={file}"]
        )
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said == [
        f"bramah: rig 'shinshu-2dof': {file}: signal piston_2 is missing; the bench needs it "
        "(`bramah dbc` writes the whole file of a rig)"
    ]


def test_the_file_of_a_rig_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command(["dbc", "--rig", "boom-1dof"])
    assert ended.value.code == 0
    assert " SG_ cap_pressure_1 : " in capsys.readouterr().out


@pytest.fixture
def adapter() -> Iterator[tuple[int, str]]:
    """The adapter's end of a serial line, and the name of the port at the host's end."""
    end, port = os.openpty()
    tty.setraw(port)
    yield end, os.ttyname(port)
    os.close(port)
    os.close(end)


def written(end: int, last: bytes) -> bytes:
    """Read the adapter's end until `last` has come: the system passes a write on in parts."""
    data = b""
    while not data.endswith(last):
        assert select.select([end], [], [], 30)[0], f"{last!r} did not come, but {data!r}"
        data += os.read(end, 4096)
    return data


def test_the_port_of_an_slcan_adapter_belongs_to_one_program(adapter: tuple[int, str]) -> None:
    end, name = adapter
    run, probe = (CanPort(BusPlace.of(f"slcan{name}"), 500_000, None, frozenset()) for _ in "12")
    run.open()
    written(end, b"O\r")  # the adapter's bus is open
    with pytest.raises(DeviceBusy, match=f"the port {name} is in use by another program"):
        probe.open()
    probe.open(shared=True)  # for a single frame that zeroes the outputs
    probe.send(CanFrame(0x80, b"\x01"))
    probe.close()
    # Nothing before it or after it that would close the bus of the run.
    assert written(end, b"1\r") == b"t080101\r"
    assert run.is_open
    assert run.fault is None
    run.close()
    assert written(end, b"C\r") == b"C\r"
    probe.open()
    probe.close()
