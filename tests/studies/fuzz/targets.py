"""What reads bytes from outside: each with valid examples and the errors that it may raise."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path

import numpy as np

from drivers.base import DeviceError, SampleBlock
from drivers.modbus_blocks import BlockDecoder
from drivers.modbus_frames import (
    payload_of,
    read_rtu_answer,
    read_tcp_frame,
    rtu_frame,
    tcp_frame,
)
from hil_sim.device.device import Device
from hil_sim.device.message_session import SerialSession
from hil_sim.link.wires import WIRES
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, parse_scenario
from protocols.files.schema import Protocol
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FrameDecoder, WireFrame, encode_frame
from rig.model.wire.registers import BlockHeader, Status
from rig.model.wire.serial_messages import Message
from rig.runs import runstate
from rig.runs.journal import Journal
from rig.runs.recorder import Recorder, RecordMeta
from rig.runs.recover import recover
from rig.runs.rigs import load_rig
from rig.runs.store import ARCHIVE, load_run

RIG = "shinshu-2dof"


@dataclass(frozen=True)
class Target:
    """A reader: `read` gets damaged examples and may raise `allowed`."""

    name: str
    examples: tuple[bytes, ...]
    read: Callable[[bytes], object]
    allowed: tuple[type[Exception], ...]


def _block(rig: Rig) -> bytes:
    layout = reg.block_layout(len(rig.channels), len(rig.joints))
    header = BlockHeader(0, 0, Status.BLOCK | Status.STREAMING, 0)
    codes = np.full((layout.samples, layout.channels), 30_000)
    return reg.pack_header(header) + reg.pack_samples(codes, np.zeros((layout.samples, 2), int))


def _blocks(rig: Rig) -> Target:
    layout = reg.block_layout(len(rig.channels), len(rig.joints))

    def read(data: bytes) -> SampleBlock | None:
        # As the drivers do: the transport has seen to the size.
        whole = data[: 2 * layout.words].ljust(2 * layout.words, b"\0")
        header = reg.unpack_header(whole)
        return BlockDecoder(rig).decode(header, whole) if header.status & Status.BLOCK else None

    return Target("blocks of samples", (_block(rig),), read, (DeviceError,))


def _answers(
    name: str,
    frame: Callable[[bytes], bytes],
    answer_in: Callable[[bytes], bytes | None],
    rig: Rig,
) -> Target:
    block = _block(rig)
    bodies = [
        bytes([23, len(block)]) + block,
        bytes([3, 4, 0, 1, 0, 2]),
        bytes([6, 0, 0x82, 0, 1]),
        bytes([16, 2, 0, 0, 20]),
        bytes([0x97, 4]),
    ]

    def read(data: bytes) -> bytes:
        answer = answer_in(data)
        return b"" if answer is None else payload_of(answer)

    return Target(name, tuple(map(frame, bodies)), read, (ValueError,))


def _tcp_answer(data: bytes) -> bytes | None:
    frame = read_tcp_frame(data)
    return None if frame is None else frame.pdu


def _serial_frames(rig: Rig) -> Target:
    layout = reg.block_layout(len(rig.channels), len(rig.joints))

    def read(data: bytes) -> None:
        decoder = FrameDecoder()
        for frame in decoder.feed(data) + decoder.feed(data[::-1]):
            if frame.type == Message.BLOCK:
                msg.unpack_block(frame.payload, layout)

    block = msg.PushedBlock(0, BlockHeader(0, 0, Status.BLOCK, 0), _block(rig)[10:])
    frames = (
        WireFrame(Message.BLOCK, 2, 5, msg.pack_block(block)),
        WireFrame(Message.REFUSED, 1, 5, msg.pack_refusal(msg.DeviceRefusal(3, 1))),
        WireFrame(Message.IDENTIFY | msg.ANSWER, 1, 5, b"\0" * 64),
    )
    return Target("serial frames", tuple(map(encode_frame, frames)), read, (ValueError,))


def _device(rig: Rig) -> Target:
    """The other end: what a host's damaged requests do to the simulated device."""
    plant = Plant(rig, Scenario(), 0)
    requests = (
        WireFrame(Message.OPEN, 1, 5, b"\x01\xf4"),
        WireFrame(Message.START, 2, 5),
        WireFrame(Message.APPLY, 3, 5, msg.pack_apply(1, [(1.0, 0.0, 0.0, 0.0, 1.0)] * 2)),
        WireFrame(Message.UPLOAD_BEGIN, 4, 5, msg.pack_upload_begin(1, 4)),
        WireFrame(Message.UPLOAD_PAGE, 5, 5, msg.pack_u32(0) + b"\0\1" * 4),
        WireFrame(Message.ALIVE_NOTE, 2, 5, msg.pack_alive(msg.Alive(0, 1))),
    )
    session = SerialSession(Device(rig, plant, realtime=True, clock=lambda: 0.0))

    def read(data: bytes) -> None:
        session.receive(data)
        session.push()

    return Target("serial requests", tuple(map(encode_frame, requests)), read, ())


def _cutters(rig: Rig) -> Target:
    def read(data: bytes) -> None:
        for wire in WIRES.values():
            for cut in (wire.framing.to_device, wire.framing.to_host):
                assert 0 <= cut(data) <= len(data)

    return Target("ends of frames", (_block(rig), b"\0\1\2\0"), read, ())


def _yaml(
    name: str, folder: str, read: Callable[[str], object], more: Sequence[bytes] = ()
) -> Target:
    package, _, inner = folder.partition("/")
    files = [f for f in (resources.files(package) / inner).iterdir() if f.name.endswith(".yaml")]
    examples = (*(f.read_bytes() for f in files), *more)

    def text(data: bytes) -> object:
        return read(data.decode("utf-8", "replace"))

    return Target(name, examples, text, (InputError,))


_FAULTS = b"""
effects: [{name: coulomb_friction, where: joint 2, force: 80 N}]
parameters: {b: 200 MPa}
faults: [{name: frame_late, probability: 0.1, delay: 3 ms}, {name: pump_off, at: 1 s}]
noise: 0.5
"""


def _a_run(folder: Path, rig: Rig, *, finish: bool) -> Path:
    """Record forty blocks into a run folder; unfinished, its journal stays as a kill leaves it."""
    from drivers.base import DeviceInfo

    recorder = Recorder(folder / "whole", rig)
    recorder.open(DeviceInfo("fuzz", 2, len(rig.channels), rig.sample_rate, 10, True))
    recorder.begin_stream()
    meta = RecordMeta("s", 1)
    number = recorder.begin_record(meta, 0)
    rng = np.random.default_rng(0)
    marks = np.zeros((10, len(rig.channels)), dtype=bool)
    for sequence in range(40):
        data = rng.normal(size=(10, len(rig.recorded)))
        recorder.append(SampleBlock(sequence, 10 * sequence, data, marks, 0, False), None)
    if finish:
        recorder.end_record(number, meta, 400, "complete", {})
        recorder.finish("done")
        return folder / "whole"
    copy = folder / "killed"
    shutil.copytree(folder / "whole", copy)
    recorder.finish("aborted")
    (copy / "owner.json").unlink(missing_ok=True)
    (copy / f"{runstate.JOURNAL}-shm").unlink(missing_ok=True)
    return copy


def _file(name: str, rig: Rig, *, finish: bool) -> Target:
    base = Path(tempfile.mkdtemp(prefix="bramah-fuzz-"))
    atexit.register(shutil.rmtree, base, ignore_errors=True)
    whole = _a_run(base, rig, finish=finish)
    what = ARCHIVE if finish else runstate.JOURNAL
    if not finish:  # let what stands in the log stand in the file
        Journal.open(whole / what).close()

    def read(data: bytes) -> None:
        folder = base / "case"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        (folder / what).write_bytes(data)
        if finish:
            load_run(folder)
        else:
            recover(folder)

    allowed = (InputError, RecordingFailed)
    return Target(name, ((whole / what).read_bytes(),), read, allowed)


MAKERS: dict[str, Callable[[], Target]] = {
    "blocks": lambda: _blocks(load_rig(RIG)),
    "modbus-tcp": lambda: _answers(
        "Modbus TCP answers", partial(tcp_frame, 7, 1), _tcp_answer, load_rig(RIG)
    ),
    "modbus-rtu": lambda: _answers(
        "Modbus RTU answers",
        partial(rtu_frame, 1),
        partial(read_rtu_answer, unit=1),
        load_rig(RIG),
    ),
    "serial": lambda: _serial_frames(load_rig(RIG)),
    "device": lambda: _device(load_rig(RIG)),
    "cutters": lambda: _cutters(load_rig(RIG)),
    "rig": lambda: _yaml(
        "rig files", "rig/shipped", lambda text: parse_model(Rig, text, "fuzz.yaml")
    ),
    "protocol": lambda: _yaml(
        "protocol files",
        "protocols/shipped",
        lambda text: parse_model(Protocol, text, "fuzz.yaml"),
    ),
    "scenario": lambda: _yaml(
        "scenario files",
        "hil_sim/scenarios",
        lambda text: parse_scenario(text, "fuzz.yaml"),
        [_FAULTS],
    ),
    "journal": lambda: _file("journals", load_rig(RIG), finish=False),
    "archive": lambda: _file("records.h5", load_rig(RIG), finish=True),
}

# Of all cases: what is read often and fast the most.
SHARES = {
    "blocks": 0.13,
    "modbus-tcp": 0.2,
    "modbus-rtu": 0.2,
    "serial": 0.2,
    "device": 0.13,
    "cutters": 0.105,
    "rig": 0.005,
    "protocol": 0.01,
    "scenario": 0.016,
    "journal": 0.002,
    "archive": 0.002,
}
