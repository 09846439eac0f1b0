"""A wire that fails by a seed: what each fault does to frames, on TCP and on a line."""

from __future__ import annotations

import math
import os
import socket
import threading
import tty
from collections.abc import Iterator

import pytest
from can.interfaces.socketcand.socketcand import convert_ascii_message_to_can_message
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from hil_sim.device.lifetime import EndpointError
from hil_sim.faults import CLASSES
from hil_sim.faults.wire import TO_DEVICE, TO_HOST, Carrier, End, WireFault
from hil_sim.link import frames
from hil_sim.link.way import QUIET, FaultInjector, Way
from hil_sim.link.wires import WIRES, faulty_link
from rig.cli.simulated.simulator import wire_faults
from rig.model.parse import InputError

KINDS = {kind.fault_name(): kind for kind in CLASSES if issubclass(kind, WireFault)}
HARMLESS = {"frame_late", "frame_split", "frames_merged", "stall", "slow_consumer"}


def fault(name: str, **keys: object) -> WireFault:
    return KINDS[name].model_validate({"name": name, **keys})


def message(*body: int) -> bytes:
    return b"\0" + bytes(body) + b"\0"


class Line:
    """One way with a clock in hand."""

    def __init__(self, *faults: WireFault, seed: int = 1) -> None:
        self.injector = FaultInjector(TO_HOST, faults, (seed,))
        self.way = Way(self.injector, frames.between_zeros)
        self.now = self.seconds = 0.0

    def send(self, data: bytes) -> list[bytes]:
        self.way.take(data, self.now, self.seconds)
        return self.arrived()

    def arrived(self, after: float = 0.0) -> list[bytes]:
        self.now += after
        return [piece.data for piece in self.way.due(self.now)]


@given(st.lists(st.binary(max_size=40), max_size=20), st.sampled_from(sorted(HARMLESS)))
@example([b"\x01", b"\x00", b"\x00"], "frames_merged")
def test_a_fault_that_loses_nothing_hands_on_every_byte_in_order(
    pieces: list[bytes], name: str
) -> None:
    line = Line(fault(name, probability=0.5))
    came = b""
    for piece in pieces:
        came += b"".join(line.send(piece))
        line.now += 0.004
    came += b"".join(line.arrived(10.0)) + b"".join(line.arrived(10.0))
    assert came == b"".join(pieces)
    assert line.way.next_time() == math.inf


def test_each_fault_does_to_frames_what_its_name_says() -> None:
    a, b, c = message(1, 2, 3), message(4, 5), message(6)

    assert Line(fault("frame_lost", most=1)).send(a + b) == [b]
    assert Line(fault("frame_duplicated")).send(a) == [a, a]
    assert Line(fault("frames_reordered", most=1)).send(a + b + c) == [b, a, c]

    late = Line(fault("frame_late", delay=0.05, most=1))
    assert late.send(a + b) == []
    assert late.arrived(0.06) == [a, b]

    merged = Line(fault("frames_merged", most=1))
    assert merged.send(a) == []
    assert merged.send(b) == [a + b]

    split = Line(fault("frame_split", pause=0.01))
    first = split.send(a)
    assert b"".join([*first, *split.arrived(0.02)]) == a
    assert 0 < len(first[0]) < len(a)

    (flipped,) = Line(fault("bits_flipped", bits=3)).send(a)
    assert sum((x ^ y).bit_count() for x, y in zip(flipped, a, strict=True)) == 3

    slow = Line(fault("slow_consumer", rate=1000.0))
    assert slow.send(a + b) == []
    assert slow.arrived(0.0051) == [a]
    assert slow.arrived(0.0041) == [b]


def test_a_late_answer_waits_for_the_next_request_and_comes_before_its_answer() -> None:
    line = Line(fault("late_answer", most=1))
    assert line.send(message(1)) == []
    assert line.arrived(100.0) == []
    line.way.other_way(line.now)
    assert line.send(message(2)) == [message(1), message(2)]


def test_an_ended_way_carries_nothing_more() -> None:
    line = Line(fault("link_half_closed"))
    assert [p.end for p in _pieces(line, message(1))] == [End.WAY]
    assert line.send(message(2)) == []


def _pieces(line: Line, data: bytes) -> list:
    line.way.take(data, line.now, line.seconds)
    return line.way.due(line.now)


def test_a_fault_strikes_in_its_time_its_share_and_its_way_only() -> None:
    line = Line(fault("frame_lost", at=2.0, until=3.0))
    passed = []
    for line.seconds in (1.9, 2.0, 2.9, 3.0):
        passed += line.send(message(1))
    assert len(passed) == 2

    half = Line(fault("frame_lost", probability=0.5))
    came = sum(len(half.send(message(1))) for _ in range(1000))
    assert 430 < came < 570
    assert half.injector.counts["frame_lost"] == 1000 - came
    again = Line(fault("frame_lost", probability=0.5))
    assert sum(len(again.send(message(1))) for _ in range(1000)) == came

    assert Line(fault("frame_lost", way=TO_DEVICE)).send(message(1)) == [message(1)]
    assert Line(fault("frame_lost", way="both")).send(message(1)) == []


def test_what_is_no_frame_goes_on_as_it_is_after_a_silence() -> None:
    line = Line(fault("frame_lost"))
    assert line.send(b"\0half a frame") == []
    assert line.arrived(2 * QUIET) == [b"\0half a frame"]


@given(st.binary(max_size=300))
def test_a_cutter_never_cuts_beyond_what_it_has(data: bytes) -> None:
    for wire in WIRES.values():
        for cut in (wire.framing.to_device, wire.framing.to_host):
            assert 0 <= cut(data) <= len(data)


@pytest.mark.parametrize(
    ("cut", "frame"),
    [
        (frames.modbus_tcp, bytes.fromhex("000100000006010300000002")),
        (frames.rtu_request, bytes.fromhex("010300000002c40b")),
        (frames.rtu_answer, bytes.fromhex("01030400010002") + b"xx"),
        (frames.rtu_answer, bytes.fromhex("018302c0f1")),
        (frames.rtu_answer, bytes.fromhex("0110000a0002") + b"xx"),
        (frames.between_zeros, message(5, 6, 7)),
        (frames.socketcand_text, b"< frame 080 1.500000 A501 >"),
        (frames.slcan_text, b"t0802A501\r"),
        (frames.slcan_text, b"\a"),
    ],
)
def test_frames_are_told_apart(cut: frames.Cutter, frame: bytes) -> None:
    assert all(cut(frame[:n]) == 0 for n in range(len(frame)))
    assert cut(frame) == cut(frame + frame) == len(frame)


@pytest.mark.parametrize(
    ("is_frame", "talk", "traffic"),
    [
        (
            frames.socketcand_frame,
            (b"< hi >", b"< ok >", b"< open can0 >", b"< rawmode >", b"< error 088 1.0 >"),
            (b"< frame 080 1.500000 A501 >", b"< send 080 2 A5 01 >", b"< send 80 0 >"),
        ),
        (
            frames.slcan_frame,
            (b"O\r", b"C\r", b"S8\r", b"\a", b"\r"),
            (b"t0802A501\r", b"T000000800\r", b"d0801A5\r"),
        ),
    ],
)
def test_what_an_adapter_says_of_itself_is_no_traffic_of_the_bus(is_frame, talk, traffic) -> None:
    assert not any(is_frame(text) for text in talk)
    assert all(is_frame(text) for text in traffic)


def test_a_fault_strikes_the_frames_of_a_can_bus_and_not_the_adapters_talk() -> None:
    framing = WIRES["can"].framing
    injector = FaultInjector(TO_HOST, [fault("frame_lost")], (1,), Carrier.CAN)
    way = Way(injector, framing.to_host, framing.on_wire, framing.error_of)
    frame = b"< frame 080 1.500000 A501 >"
    assert way.take(b"< hi >< ok >" + frame + b"< ok >", 0.0, 0.0) == 1
    assert [piece.data for piece in way.due(0.0)] == [b"< hi >", b"< ok >", b"< ok >"]
    assert injector.counts == {"frame_lost": 1}


def test_a_damaged_frame_of_a_can_bus_is_an_error_frame_or_nothing_and_never_a_frame() -> None:
    frame = b"< frame 080 1.500000 A501 >"
    for wire, text, arrives in (
        ("can", frame, [b"< error 00000088 1.500000 >"]),
        ("can-slcan", b"t0802A501\r", []),  # its text has no word for error frames
    ):
        framing = WIRES[wire].framing
        injector = FaultInjector(TO_HOST, [fault("bits_flipped")], (1,), Carrier.CAN)
        way = Way(injector, framing.to_host, framing.on_wire, framing.error_of)
        way.take(text, 0.0, 0.0)
        assert [piece.data for piece in way.due(0.0)] == arrives
    read = convert_ascii_message_to_can_message("< error 00000088 1.500000 >")
    assert read.is_error_frame


# -- on real wires -----------------------------------------------------------------------------


@pytest.fixture
def echo() -> Iterator[str]:
    """A device on TCP that answers what it hears."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                end, _ = listener.accept()
            except OSError:
                return
            with end:
                while data := end.recv(4096):
                    end.sendall(data)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"modbus-tcp://127.0.0.1:{listener.getsockname()[1]}"
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(5)


def connect(endpoint: str) -> socket.socket:
    end = socket.create_connection(("127.0.0.1", int(endpoint.rsplit(":", 1)[1])))
    end.settimeout(5.0)
    return end


FRAME = bytes.fromhex("000100000006010300000002")


def test_a_host_meets_the_faults_of_a_tcp_link_and_none_when_it_is_healthy(echo: str) -> None:
    with faulty_link(echo) as link, connect(link.endpoint) as end:
        end.sendall(FRAME)
        assert end.recv(99) == FRAME
        link.use([fault("frame_lost", most=1), fault("frame_duplicated")])
        end.sendall(FRAME)
        end.sendall(FRAME)
        answers = b""
        while len(answers) < 2 * len(FRAME):
            answers += end.recv(99)
        assert answers == 2 * FRAME
        assert link.injected == {"frame_lost": 1, "frame_duplicated": 1}
        link.use([fault("link_half_closed")])
        end.sendall(FRAME)
        assert end.recv(99) == b""
        end.sendall(FRAME)  # the other way is still there


def test_a_cut_tcp_link_ends_both_sides_and_takes_a_new_connection(echo: str) -> None:
    with faulty_link(echo) as link:
        with connect(link.endpoint) as end:
            end.sendall(FRAME)
            assert end.recv(99) == FRAME
            link.cut()
            assert end.recv(99) == b""
        with connect(link.endpoint) as end:
            end.sendall(FRAME)
            assert end.recv(99) == FRAME


def test_a_pulled_plug_takes_the_port_away_and_its_name_leads_to_the_next() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    with faulty_link(f"serial://{os.ttyname(slave)}") as link:
        path = link.endpoint.removeprefix("serial://")
        for _ in range(2):
            host = os.open(path, os.O_RDWR | os.O_NOCTTY)
            os.write(host, message(1, 2))
            assert os.read(master, 99) == message(1, 2)
            os.write(master, message(3))
            assert os.read(host, 99) == message(3)
            link.cut()
            with pytest.raises(OSError, match="Input/output error"):
                os.write(host, message(4))
            os.close(host)
    os.close(slave)
    os.close(master)


def test_names_and_files_of_wire_faults_are_read_or_refused_with_what_is_expected(tmp_path) -> None:
    (usual,) = wire_faults("frame_lost")
    assert usual.probability == 0.01
    assert wire_faults(None) == ()
    path = tmp_path / "bad.yaml"
    path.write_text("faults: [{name: pump_off}]")
    with pytest.raises(InputError, match="expected faults of the wire only"):
        wire_faults(str(path))
    path.write_text("faults: [{name: frame_late, delay: 20 ms, way: both, probability: 0.1}]")
    assert wire_faults(str(path)) == (fault("frame_late", delay=0.02, way="both", probability=0.1),)
    with pytest.raises(InputError, match="one of: bits_flipped frame_duplicated"):
        wire_faults("frame_gone")
    with pytest.raises(ValidationError):
        fault("frame_lost", probability=0.0)
    with pytest.raises(EndpointError, match="no faults for wire replay"):
        faulty_link("replay://x")
