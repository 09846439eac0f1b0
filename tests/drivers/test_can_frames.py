"""Messages and samples as frames of a CAN bus: nothing damaged is ever taken for whole."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from importlib import resources

import cantools
import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from hypothesis import given
from hypothesis import strategies as st

from rig.model.parse import InputError
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.can_database import database_text
from rig.model.wire.can_frames import (
    BlockCollector,
    CanFrame,
    PartCollector,
    alive_frame,
    block_frames,
    frame_bits,
    part_frames,
    read_alive,
    stream_seconds,
)
from rig.model.wire.can_layout import CanLayout, CanMessage, _place, read_layout
from rig.model.wire.codes import decode_input, decode_output
from rig.model.wire.frames import MAX_PAYLOAD, WireFrame
from rig.model.wire.registers import BlockHeader, Status
from tests.hil_sim.block_samples import unpack_samples
from tests.hil_sim.integrator import seed_rig

RIG = seed_rig()
BLOCK = reg.block_layout(len(RIG.channels), len(RIG.joints))
TEXT = {fd: database_text(RIG, fd=fd) for fd in (False, True)}
LAYOUT = {fd: read_layout(TEXT[fd], "made.dbc", RIG) for fd in TEXT}
STREAM, SESSION = 7, 0x1A2B3C4D

messages = st.builds(
    WireFrame,
    st.integers(0, 255),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF_FFFF),
    st.binary(max_size=MAX_PAYLOAD),
)
either = st.booleans()


def block(seed: int = 1, **header: int) -> WireFrame:
    rng = np.random.default_rng(seed)
    measured = rng.integers(0, 1 << 16, (BLOCK.samples, BLOCK.channels))
    commands = rng.integers(-2047, 2048, (BLOCK.samples, BLOCK.joints))
    head = BlockHeader(**{"sequence": 5, "tick": 1234, "status": Status(9), "backlog": 2, **header})
    pushed = msg.PushedBlock(3, head, reg.pack_samples(measured, commands))
    return WireFrame(msg.Message.BLOCK, STREAM, SESSION, msg.pack_block(pushed))


def collected(layout: CanLayout, frames: Sequence[CanFrame], stream: int = STREAM) -> list:
    found = BlockCollector(layout, BLOCK)
    whole = [found.feed(f.identifier, f.data, stream, SESSION) for f in frames]
    return [message for message in whole if message is not None]


def joined(frames: Sequence[CanFrame]) -> list[WireFrame]:
    parts = PartCollector()
    whole = [parts.feed(frame.data) for frame in frames]
    return [message for message in whole if message is not None]


def spoiled(frames: list[CanFrame], rng: random.Random) -> list[CanFrame]:
    """Lose, repeat, exchange or change one frame."""
    k = rng.randrange(len(frames))
    before, one, after = frames[:k], frames[k], frames[k + 1 :]
    at = rng.randrange(8 * len(one.data))
    bits = int.from_bytes(one.data, "little") ^ 1 << at
    flipped = CanFrame(one.identifier, bits.to_bytes(len(one.data), "little"))
    return [
        before + after,
        [*before, one, one, *after],
        [*before, *after[:1], one, *after[1:]],
        [*before, flipped, *after],
        [*before, CanFrame(one.identifier, one.data[:-1]), *after],
    ][rng.randrange(5)]


@given(messages, either)
def test_a_message_comes_out_of_its_parts(message: WireFrame, fd: bool) -> None:
    frames = part_frames(LAYOUT[fd].request, message)
    assert all(len(frame.data) <= (64 if fd else 8) for frame in frames)
    assert joined(frames) == [message]
    assert joined(frames[1:] + frames) == [message]  # after the end of another one


@given(messages, either, st.randoms(use_true_random=False))
def test_a_spoiled_message_is_whole_or_nothing(
    message: WireFrame, fd: bool, rng: random.Random
) -> None:
    frames = spoiled(part_frames(LAYOUT[fd].answer, message), rng)
    following = WireFrame(1, 2, 3, b"next")
    *before, last = joined([*frames, *part_frames(LAYOUT[fd].answer, following)])
    assert last == following
    # One frame that comes twice is a message that comes twice: sessions carry it out once.
    assert before in ([], [message], [message, message])


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_a_block_comes_out_of_its_frames(fd: bool) -> None:
    message = block()
    frames = block_frames(LAYOUT[fd], BLOCK, message)
    assert len(frames) == 2 + 10 * (1 if fd else 4)
    assert collected(LAYOUT[fd], frames) == [message]
    assert collected(LAYOUT[fd], frames[5:] + frames) == [message]
    assert collected(LAYOUT[fd], frames, stream=STREAM + 1) == []


@given(st.randoms(use_true_random=False), either, st.integers(1, 3))
def test_a_spoiled_block_is_whole_or_nothing(rng: random.Random, fd: bool, faults: int) -> None:
    first, second = block(rng.randrange(99)), block(99 + rng.randrange(99), sequence=6, tick=1244)
    frames = block_frames(LAYOUT[fd], BLOCK, first) + block_frames(LAYOUT[fd], BLOCK, second)
    for _ in range(faults):
        frames = spoiled(frames, rng)
    assert [m for m in collected(LAYOUT[fd], frames) if m not in (first, second)] == []


def test_a_block_that_took_a_value_of_the_next_one_is_dropped() -> None:
    # The last row lost a frame, and the next block its first two: the rows fill each other up.
    first = block_frames(LAYOUT[False], BLOCK, block(1))
    second = block_frames(LAYOUT[False], BLOCK, block(2, sequence=6, tick=1244))
    mixed = [*first[:-3], *first[-2:-1], second[3], first[-1]]
    assert collected(LAYOUT[False], mixed) == []


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_any_program_with_the_dbc_file_reads_the_samples(fd: bool) -> None:
    database = cantools.database.load_string(TEXT[fd], "dbc")
    message = block()
    samples = msg.unpack_block(message.payload, BLOCK).samples
    measured, commands = unpack_samples(samples, BLOCK)
    row, seen = -1, np.full((BLOCK.samples, BLOCK.columns), np.nan)
    for frame in block_frames(LAYOUT[fd], BLOCK, message):
        found = database.decode_message(frame.identifier, frame.data)
        row = int(found.pop("row", row))
        for name, value in found.items():
            if name in RIG.recorded:
                seen[row, RIG.recorded.index(name)] = value
    spool, piston = RIG.sensors.spool, RIG.sensors.piston
    assert seen[:, 0] == pytest.approx(decode_input(measured[:, 0], *spool.range, 16), abs=1e-9)
    assert seen[:, 5] == pytest.approx(decode_input(measured[:, 5], *piston.range, 16), abs=1e-9)
    assert seen[:, 11] == pytest.approx(decode_output(commands[:, 1], 10.0, 12), abs=1e-9)
    assert np.isfinite(seen).all()


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), either)
def test_a_sign_of_life_is_for_one_session(
    number: int, acknowledge: int, heartbeat: int, resend: bool
) -> None:
    payload = msg.pack_alive(msg.Alive(acknowledge, heartbeat, resend))
    note = WireFrame(msg.Message.ALIVE_NOTE, number, SESSION, payload)
    frame = alive_frame(LAYOUT[False], note)
    assert read_alive(LAYOUT[False], frame.data, SESSION) == note
    assert read_alive(LAYOUT[False], frame.data, SESSION ^ 1) is None
    assert read_alive(LAYOUT[False], frame.data[:-1], SESSION) is None


def test_a_hundred_thousand_random_frames_are_survived() -> None:
    rng = random.Random(5)
    for fd, layout in LAYOUT.items():
        parts, blocks = PartCollector(), BlockCollector(layout, BLOCK)
        keys = [m.key for m in (layout.sync, layout.check, *layout.rows)]
        good = block_frames(layout, BLOCK, block())
        for _ in range(25_000):
            data = rng.randbytes(rng.randrange(65 if fd else 9))
            parts.feed(bytes([parts._next]) + data if rng.random() < 0.8 else data)
            blocks.feed(rng.choice(keys), data, STREAM, SESSION)
            assert len(parts._stream) <= 400
        whole = [blocks.feed(f.identifier, f.data, STREAM, SESSION) for f in good]
        assert whole[-1] == block()
        assert parts.damaged > 1000


# -- places in frames, whatever the file says -------------------------------------------------


@given(
    st.integers(1, 32),
    st.integers(0, 63),
    either,
    either,
    st.integers(0, 0xFFFF_FFFF),
)
def test_a_signal_is_read_where_cantools_puts_it(
    bits: int, start: int, big: bool, signed: bool, value: int
) -> None:
    order = "big_endian" if big else "little_endian"
    try:
        signal = Signal("x", start, bits, byte_order=order, is_signed=signed)
        message = Message(1, "m", 8, [signal], strict=True)
    except cantools.database.Error:
        return  # it reaches beyond the frame
    raw = value & ((1 << bits) - 1)
    raw -= (1 << bits) if signed and raw >> (bits - 1) else 0
    place = CanMessage("m", 1, False, 8, False, {"x": _place(signal, 8)})
    expected = message.encode({"x": raw}, scaling=False)
    assert place.pack({"x": raw}) == expected
    assert place.unpack(expected) == {"x": raw}


def test_the_shipped_file_is_the_one_made_for_its_rig() -> None:
    shipped = resources.files("rig") / "shipped" / "shinshu-2dof.dbc"
    assert shipped.read_text("utf-8") == TEXT[False]


def without(name: str) -> str:
    lines = [line for line in TEXT[False].splitlines() if not line.startswith(f" SG_ {name} ")]
    assert len(lines) < len(TEXT[False].splitlines())
    return "\n".join(lines)


@pytest.mark.parametrize("name", ["zero_key", "alive_resend", "check_sum", "row", "piston_2"])
def test_a_missing_signal_is_named(name: str) -> None:
    with pytest.raises(InputError, match=rf"^my.dbc: signal {name} is missing; the bench needs it"):
        read_layout(without(name), "my.dbc", RIG)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("(154.11612115663385,-100000.0)", "(154.2,-100000.0)", "cap_pressure_1: factor 154.2"),
        ("SG_ piston_1 : 24|16", "SG_ piston_1 : 24|12", "piston_1 has 12 bits, expected 16"),
        ("0|16@1- (0.0048", "0|16@1+ (0.0048", r"command_2: factor .*, signed$"),
        ("SG_ rod_pressure_2 ", "SG_ rod_pressure_1 ", "rod_pressure_1 stands in bench_row_2 and"),
        ("BO_ 176 bench_answer", "BO_ 160 bench_answer", "share the identifier 0xA0"),
        ("SG_ request_part : 0|8", "SG_ request_part : 8|8", "expected the first byte"),
        ("BO_ 144 host_alive: 8", "BO_ 144 host_alive: x", "not a DBC file"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(before: str, after: str, says: str) -> None:
    assert before in TEXT[False]
    with pytest.raises(InputError, match=rf"^my.dbc: .*{says}") as caught:
        read_layout(TEXT[False].replace(before, after, 1), "my.dbc", RIG)
    assert "\n" not in str(caught.value)


@given(st.integers(0, 10_000), st.binary(min_size=1, max_size=30))
def test_a_damaged_file_is_refused_in_one_line(at: int, junk: bytes) -> None:
    text = TEXT[False]
    place = at % len(text)
    torn = text[:place] + junk.decode("cp1252", "replace") + text[place + 20 :]
    said = ""
    try:
        read_layout(torn, "my.dbc", RIG)
    except InputError as error:
        said = str(error)
    assert "\n" not in said


# -- what fits on a bus ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "extended", "bits"), [(0, False, 55), (8, False, 135), (8, True, 160), (1, False, 65)]
)
def test_classic_frames_take_the_published_number_of_bits(
    size: int, extended: bool, bits: int
) -> None:
    # Davis et al., Controller Area Network schedulability analysis, 2007: 55 + 10 n, 80 + 10 n.
    assert frame_bits(CanFrame(1, bytes(size), extended)) == (bits, 0)
    assert bits == (80 if extended else 55) + 10 * size


def test_sixteen_channels_at_a_kilohertz_fit_as_integers() -> None:
    seconds = stream_seconds(LAYOUT[False], BLOCK, 1e6, 1e6)
    assert seconds / 10e-3 == pytest.approx(0.51, abs=0.01)
    as_float = 8 * (47 + 8 * 8 + 24) * 1000
    assert as_float > 1e6


def test_identifiers_and_codes_survive_other_databases() -> None:
    """A file of the bench's own making: one Motorola message a channel, 29-bit identifiers."""
    layout = read_layout(own_database(), "own.dbc", RIG)
    message = block(3)
    frames = block_frames(layout, BLOCK, message)
    assert len(frames) == 2 + 10 * 13
    assert all(frame.extended for frame in frames)
    found = BlockCollector(layout, BLOCK)
    whole = [found.feed(f.identifier | 1 << 31, f.data, STREAM, SESSION) for f in frames]
    assert whole[-1] == message


def own_database() -> str:
    """The same bench in another firmware's words."""
    made = cantools.database.load_string(TEXT[False], "dbc")
    out = []
    identifier = 0x1_0000
    for message in made.messages:
        groups = [[s] for s in message.signals] if "row" in message.name else [message.signals]
        for signals in groups:
            placed, start = [], 7
            for signal in sorted(signals, key=lambda s: s.start):
                bits = signal.length
                placed.append(
                    Signal(
                        signal.name,
                        start if "_part" not in signal.name else 7,
                        bits,
                        byte_order="big_endian",
                        is_signed=signal.is_signed,
                        conversion=signal.conversion,
                    )
                )
                first = 8 * (start // 8) + 7 - start % 8 + bits
                start = 8 * (first // 8) + 7 - first % 8
            name = message.name if len(groups) == 1 else f"of_{signals[0].name}"
            out.append(Message(identifier, name, 8, placed, is_extended_frame=True))
            identifier += 1
    text: str = Database(out, version="").as_dbc_string()
    return text


def test_a_block_of_another_size_is_no_block() -> None:
    wrong = WireFrame(msg.Message.BLOCK, 1, 1, b"\0" * 30)
    with pytest.raises((ValueError, struct.error)):
        block_frames(LAYOUT[False], BLOCK, wrong)
