"""Detects a journal's tail that is missing, cut off or zeroed.

A journal is named after its tail has all its bytes, so that a tail of another size was damaged. Its
bytes are zeros until the first block, and a block is written there before it is acknowledged; the
rows of one pass stay until the next pass overwrites them. So zeros where the pass before wrote are
damage, and so is a tail without rows of a stream that the run's events say had begun.
"""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rig.model.rig import Rig
from rig.runs.journal import (
    ENTRY_BEGIN,
    TAIL_BLOCKS,
    TAIL_BYTES,
    BlockRow,
    entries,
    entry_bytes,
    tail_of,
)
from rig.runs.runstate import STREAM, read_events

_NEWEST: Final = (
    "SELECT samples, length(data) + length(saturated) FROM block ORDER BY id DESC LIMIT ?"
)


def find_tail_damage(
    path: Path, db: sqlite3.Connection, rig: Rig, rows: Sequence[BlockRow]
) -> str | None:
    """Return the damage of the tail of the journal `path` in words, None if it is intact.

    `rows` are those read from it, behind those of the database `db`. Raises OSError, sqlite3.Error.
    """
    tail = tail_of(path)
    stored = db.execute(_NEWEST, (TAIL_BLOCKS,)).fetchall()
    lengths = [samples for samples, _ in stored] + [row.samples for row in rows]
    data = tail.read_bytes() if tail.is_file() else None
    if data is None:
        fault = "is missing"
    elif len(data) != TAIL_BYTES:
        fault = f"has {len(data)} bytes, not {TAIL_BYTES}"
    elif _zeroed(data, len(rows), [size for _, size in stored], _largest(lengths, rig)):
        fault = "is filled with zeros"
    elif _rows_beyond(data, len(rows), max((row.id for row in rows), default=-1)):
        return f"blocks before the newest in {tail.name} are missing"
    elif _stream_without_blocks(path.parent, db, rows):
        fault = "lacks the first blocks of the last stream"
    else:
        return None
    held = (TAIL_BLOCKS - 1) * max(lengths, default=0)
    most = f"up to {held} samples ({held / rig.sample_rate:.3f} s)" if held else "samples"
    return f"{tail.name} {fault}; {most}, the newest, may have been in it"


def _rows_beyond(data: bytes, count: int, newest: int) -> bool:
    """Return whether rows newer than `newest` lie behind the first `count` rows of a tail."""
    begin = data.find(ENTRY_BEGIN, _end_of(data, count))
    while newest >= 0 and begin >= 0:
        _, row = next(entries(data[begin:]), (0, None))
        if row is not None and row.id > newest:
            return True
        begin = data.find(ENTRY_BEGIN, begin + 1)
    return False


def _largest(lengths: Sequence[int], rig: Rig) -> int:
    """Return the most bytes of samples and marks of a block of so many samples."""
    longest = max(lengths, default=0)
    return longest * 8 * len(rig.recorded) + (longest * len(rig.channels) + 7) // 8


def _zeroed(data: bytes, count: int, stored: Sequence[int], largest: int) -> bool:
    """Return whether zeros stand where the pass before wrote rows.

    `stored` are the sizes of the newest rows of the database, at most as many as make one pass. A
    pass ends with TAIL_BLOCKS rows, or where the next one has no room. The row that was being
    written when the process died may be torn.
    """
    if not stored or entry_bytes(largest) > TAIL_BYTES:
        return False
    pass_end = min(TAIL_BLOCKS * entry_bytes(min(stored)), TAIL_BYTES - entry_bytes(largest))
    rest = data[_end_of(data, count) + entry_bytes(largest) : pass_end]
    return len(rest) >= entry_bytes(largest) and not any(rest)


def _end_of(data: bytes, count: int) -> int:
    """Return where the first `count` rows of a tail end."""
    ends = [end for end, _ in itertools.islice(entries(data), count)]
    return ends[-1] if ends else 0


def _stream_without_blocks(folder: Path, db: sqlite3.Connection, rows: Sequence[BlockRow]) -> bool:
    """Return whether the events name a stream, written after its first block, that has none."""
    (newest,) = db.execute("SELECT max(stream) FROM block").fetchone()
    streams: list[Any] = [e.get("stream") for e in read_events(folder) if e.get("event") == STREAM]
    begun = max((s for s in streams if isinstance(s, int)), default=0)
    return begun > max([newest or 0, *(row.stream for row in rows)])
