"""Finds rows of a journal in the raw bytes of its files, independently of SQLite.

A row of a table is stored as (lengths of) payload and rowid, a header that gives one type per
column, then the columns ("Database File Format", sqlite.org, section 2.1). A header of the block
table differs clearly from samples, and the block's checksum verifies the row; so no page structure
is needed, and the write-ahead log is read like the database. A row longer than a page is stored in
pieces and is not found.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.runs.journal import Mark, describes_record

Bytes = NDArray[np.uint8]
Like = Callable[[list[Bytes]], Any]  # to a mask, one flag per place

_CHUNK = 1 << 24
_OVERLAP = 1 << 16  # the largest page: an undivided row is not longer
_INTEGER = (0, 1, 2, 3, 4, 6, 8)  # bytes of the integer types 0 (NULL) to 6
_NULL, _REAL, _ZERO, _ONE = 0, 7, 8, 9
_STATES = {"open": 21, "complete": 29, "partial": 27, "discarded": 31}  # type of each text


@dataclass(frozen=True)
class SalvagedRow:
    """A row's columns and its number (None if that is damaged)."""

    number: int | None
    values: tuple[Any, ...]


def raw_bytes(path: Path) -> Bytes:
    """Map a file for reading; an absent or empty one has no bytes."""
    if not path.is_file() or path.stat().st_size == 0:
        return np.empty(0, dtype=np.uint8)
    return np.memmap(path, dtype=np.uint8, mode="r")


def block_rows(raw: Bytes) -> Iterator[SalvagedRow]:
    """Yield candidate rows of the block table; the checksum has to confirm them."""

    def like(types: list[Bytes]) -> Any:
        return np.logical_and.reduce([kind <= _ONE for kind in types[1:]])

    yield from _rows(raw, 9, 7, like)


def marks(raw: Bytes) -> Iterator[Mark]:
    """Yield the marks found, including older versions of each."""

    def like(types: list[Bytes]) -> Any:
        number = [t <= _ONE for t in types[1:4]]
        return np.logical_and.reduce([*number, np.isin(types[4], list(_STATES.values()))])

    for row in _rows(raw, 6, 5, like):
        _, stream, start, ticks, state, text = row.values
        try:
            meta = json.loads(text)
            is_record = describes_record(meta)
        except (ValueError, TypeError):
            continue
        if is_record and state in _STATES and isinstance(stream, int) and isinstance(start, int):
            yield Mark(row.number or 0, stream, start, ticks, state, meta)


def _rows(raw: Bytes, columns: int, short: int, like: Like) -> Iterator[SalvagedRow]:
    """Yield rows with `columns` columns, of which the first is NULL (the rowid).

    `like` tests the types of the first `short` columns, each one byte in the header.
    """
    for begin in range(0, len(raw), _CHUNK):
        chunk = np.asarray(raw[begin : begin + _CHUNK + _OVERLAP])
        count = min(_CHUNK, len(chunk) - columns - 1)
        if count <= 0:
            continue
        head = chunk[:count]
        matches = (head > columns) & (head <= columns + 9) & (chunk[1 : count + 1] == _NULL)
        offsets = np.flatnonzero(matches)
        if not len(offsets):
            continue
        types = [chunk[offsets + 1 + k] for k in range(short)]
        for offset in offsets[like(types)].tolist():
            row = _row(chunk, offset, columns)
            if row is not None:
                yield SalvagedRow(*row)


def _row(chunk: Bytes, offset: int, columns: int) -> tuple[int | None, tuple[Any, ...]] | None:
    end = offset + int(chunk[offset])
    position = offset + 1
    types: list[int] = []
    while position < end and len(types) < columns:
        value, position = _varint(chunk, position)
        types.append(value)
    if position != end or len(types) != columns:
        return None
    sizes = [_size(kind) for kind in types]
    if any(size is None for size in sizes):
        return None
    row_end = end + sum(size or 0 for size in sizes)
    if row_end > len(chunk):
        return None
    values = []
    for kind, size in zip(types, sizes, strict=True):
        values.append(_value(kind, chunk[end : end + (size or 0)].tobytes()))
        end += size or 0
    return _number(chunk, offset, row_end - offset), tuple(values)


def _varint(chunk: Bytes, position: int) -> tuple[int, int]:
    """Return a number of seven bits per byte, most significant first, and its end."""
    value = 0
    for k in range(position, min(position + 9, len(chunk))):
        byte = int(chunk[k])
        value = (value << 7) | (byte & 0x7F)
        if byte < 0x80:
            return value, k + 1
    return value, len(chunk) + 1


def _as_varint(value: int) -> bytes:
    digits = [value & 0x7F]
    while value := value >> 7:
        digits.append(0x80 | (value & 0x7F))
    return bytes(reversed(digits))


def _size(kind: int) -> int | None:
    """Return the bytes of a column of this type, None for a type that does not exist."""
    if kind < len(_INTEGER):
        return _INTEGER[kind]
    if kind in (_REAL, _ZERO, _ONE):
        return 8 if kind == _REAL else 0
    return (kind - 12) // 2 if kind >= 12 else None


def _value(kind: int, raw: bytes) -> Any:
    if kind == _NULL:
        return None
    if kind < len(_INTEGER):
        return int.from_bytes(raw, "big", signed=True)
    if kind == _REAL:
        return float(np.frombuffer(raw, dtype=">f8")[0])
    if kind in (_ZERO, _ONE):
        return kind - _ZERO
    return raw if kind % 2 == 0 else raw.decode("utf-8", errors="replace")


def _number(chunk: Bytes, offset: int, payload: int) -> int | None:
    """Return the rowid, stored between the payload's length and the payload."""
    length = _as_varint(payload)
    for size in range(1, 6):
        begin = offset - size - len(length)
        if begin < 0 or chunk[begin : begin + len(length)].tobytes() != length:
            continue
        value, end = _varint(chunk, offset - size)
        if end == offset:
            return value
    return None


def best_marks(marks: Sequence[Mark]) -> list[Mark]:
    """Return one version of each mark, the closed one if present, in order of start."""
    best: dict[tuple[int, int, str], Mark] = {}
    for mark in marks:
        key = (mark.stream, mark.start, str(mark.meta["name"]))
        if key not in best or best[key].state == "open":
            best[key] = mark
    return [best[key] for key in sorted(best)]
