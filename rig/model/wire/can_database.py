"""The default DBC file of a rig: classic CAN, or CAN FD.

A signal has the name of its channel and converts to its SI unit, 16 bits each, low byte first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire import can_layout as names

HOST: Final = "host"
BENCH: Final = "bench"
FD_BYTES: Final = 64

# Lower identifiers have priority: zero and heartbeats, requests, then samples.
ZERO_ID: Final = 0x080
ALIVE_ID: Final = 0x090
REQUEST_ID: Final = 0x0A0
ANSWER_ID: Final = 0x0B0
SYNC_ID: Final = 0x100
ROW_ID: Final = 0x101
CHECK_ID: Final = 0x17F

_COLUMN_BITS = 16


def database_text(rig: Rig, *, fd: bool = False) -> str:
    """Return the text of a DBC file for a rig."""
    size = FD_BYTES if fd else names.CLASSIC_BYTES
    messages = [
        _message("host_zero", ZERO_ID, names.ZERO, HOST, note="All outputs to zero, at once."),
        _message("host_alive", ALIVE_ID, names.ALIVE, HOST, note="Sign of life, one a block."),
        _parts("host_request", REQUEST_ID, names.REQUEST, HOST, size),
        _parts("bench_answer", ANSWER_ID, names.ANSWER_PARTS, BENCH, size),
        _message("bench_sync", SYNC_ID, names.SYNC, BENCH, note="A block begins."),
        *_rows(rig, size),
        _message("bench_check", CHECK_ID, names.CHECK, BENCH, note="The block has ended."),
    ]
    database = Database(messages, [Node(HOST, None), Node(BENCH, None)], version="")
    # The library writes carriage returns; readers accept lines without.
    return database.as_dbc_string().replace("\r\n", "\n")


def _message(
    name: str, identifier: int, signals: Mapping[str, int], sender: str, *, note: str
) -> Message:
    placed, start = [], 0
    for signal, bits in signals.items():
        placed.append(_signal(signal, start, bits, sender))
        start += bits
    return Message(identifier, name, -(-start // 8), placed, comment=note, senders=[sender])


def _parts(
    name: str, identifier: int, signals: Mapping[str, int], sender: str, size: int
) -> Message:
    (signal,) = signals
    note = "Part of a message: its place in the first byte, its bytes in the others."
    placed = [_signal(signal, 0, 8, sender)]
    return Message(identifier, name, size, placed, comment=note, senders=[sender])


def _rows(rig: Rig, size: int) -> Iterator[Message]:
    placed = [_signal("row", 0, 8, BENCH)]
    start, index = 8, 0
    for column in rig.recorded:
        if start + _COLUMN_BITS > 8 * size:
            yield _row(index, start, placed)
            placed, start, index = [], 0, index + 1
        placed.append(_column(rig, column, start))
        start += _COLUMN_BITS
    yield _row(index, start, placed)


def _row(index: int, bits: int, signals: list[Signal]) -> Message:
    size = next(size for size in names.FD_SIZES if 8 * size >= bits)
    note = "Samples of one tick; the frames of a row follow each other."
    name = f"bench_row_{index + 1}"
    return Message(ROW_ID + index, name, size, signals, comment=note, senders=[BENCH])


def _column(rig: Rig, name: str, start: int) -> Signal:
    low, high, top, signed = names.converter_of(rig, name)
    return Signal(
        name,
        start,
        _COLUMN_BITS,
        is_signed=signed,
        conversion=BaseConversion.factory((high - low) / top, low),
        minimum=-high if signed else low,
        maximum=high,
        unit=ch.unit_of(name),
        receivers=[HOST],
    )


def _signal(name: str, start: int, bits: int, sender: str) -> Signal:
    return Signal(name, start, bits, receivers=[HOST if sender == BENCH else BENCH])
