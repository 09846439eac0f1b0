"""Detects damaged journals, and rebuilds a journal from the readable part.

The files of a damaged journal are not changed. Lost samples are: the gaps between readable blocks
(without those lost on the wire, which the events state), the blocks before the first readable one
(by its number), and samples after the last readable one according to events and marks.
"""

from __future__ import annotations

import itertools
import logging
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.base import SampleBlock
from rig.model.rig import Rig
from rig.runs.files import sync_to_disk
from rig.runs.journal import (
    JOURNAL_FILES,
    Block,
    BlockRow,
    Journal,
    Mark,
    decode_row,
    describes_record,
    read_tail,
    tail_of,
)
from rig.runs.runstate import read_events
from rig.runs.salvage.scan import best_marks, block_rows, marks, raw_bytes
from rig.runs.salvage.tail import find_tail_damage

log = logging.getLogger(__name__)

REBUILT: Final = "journal.rebuilt.sqlite"
DAMAGED: Final = "journal.damaged"
CUT_OFF: Final = "the end of its write-ahead log is cut off"
_WAL_HEADER, _FRAME_HEADER = 32, 24
_AT_ONCE = 256  # rows per query; if one is unreadable, each is read alone
_UNREADABLE = (
    sqlite3.Error, OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError,
)  # fmt: skip


@dataclass(frozen=True)
class Salvage:
    """Contents of a damaged journal; `lost`: samples known to be missing."""

    blocks: int
    samples: int
    lost: int
    lost_blocks: int
    nameless: tuple[str, ...]


def find_damage(path: Path, rig: Rig) -> str | None:
    """Return the damage of a journal in words, None if it is intact."""
    log_file = path.with_name(path.name + "-wal")
    try:
        with closing(_open(path)) as db:
            (report,) = db.execute("PRAGMA integrity_check(1)").fetchone()
            if report != "ok":
                return f"its pages are damaged ({' '.join(str(report).split())})"
            newest = _check_rows(Journal(db, path), db, rig)
    except _UNREADABLE as error:
        return f"SQLite cannot read it ({error})"
    if isinstance(newest, str):
        return newest
    raw = raw_bytes(log_file)
    rows = (_as_block(row.values, rig) for row in block_rows(raw))
    if any(block is not None and (block.stream, block.tick) > newest for block in rows):
        return "its write-ahead log is damaged before its end"
    return CUT_OFF if _torn(raw) else None


def _open(path: Path) -> sqlite3.Connection:
    """Open a journal without changing its files: no log is written back."""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)


def _check_rows(journal: Journal, db: sqlite3.Connection, rig: Rig) -> str | tuple[int, int]:
    """Return the damage of the rows in words, or the newest block as (stream, tick)."""
    for key, value, fault in (
        ("columns", list(rig.recorded), "its columns are not those"),
        ("measured", len(rig.channels), "its count of sensors is not that"),
        ("sample_rate", rig.sample_rate, "its sample rate is not that"),
    ):
        if journal.meta(key) != value:
            return f"{fault} of the run's rig"
    if not all(describes_record(mark.meta) for mark in journal.marks()):
        return "the description of a record cannot be read"
    newest, count = (-1, -1), 0
    for _, block in journal.blocks():
        if block is None:
            return "the checksum of a block does not match"
        if (block.stream, block.tick) <= newest:
            return "its blocks are out of order"
        newest, count = (block.stream, block.tick), count + 1
    (rows, highest) = db.execute("SELECT count(*), max(id) FROM block").fetchone()
    if not rows == count == (highest or 0):
        return "blocks are missing"
    return _check_tail(journal.path, db, rig, newest, count)


def _check_tail(
    path: Path, db: sqlite3.Connection, rig: Rig, newest: tuple[int, int], count: int
) -> str | tuple[int, int]:
    """Return the damage of the tail behind the database's `count` rows, or the newest block."""
    rows = read_tail(path, after=count)
    for row in rows:
        block = _as_block(row, rig)
        if block is None or (block.stream, block.tick) <= newest or row.id != count + 1:
            return f"blocks before the newest in {tail_of(path).name} are missing"
        newest, count = (block.stream, block.tick), row.id
    return find_tail_damage(path, db, rig, rows) or newest


def _torn(raw: Any) -> bool:
    if len(raw) < _WAL_HEADER:
        return len(raw) > 0
    page = int.from_bytes(raw[8:12].tobytes(), "big")
    return page > 0 and (len(raw) - _WAL_HEADER) % (page + _FRAME_HEADER) != 0


def _as_block(row: tuple[Any, ...], rig: Rig) -> Block | None:
    """Return the block of a row without its number, None if the checksum does not match."""
    values = row[1:]
    if not all(isinstance(value, int) for value in (*values[:4], values[5])):
        return None
    try:
        return decode_row(values, len(rig.recorded), len(rig.channels))
    except _UNREADABLE:
        return None


def rebuild(path: Path, rig: Rig) -> tuple[Journal, Salvage]:
    """Write the readable part of a damaged journal into a new, open journal beside it.

    Raises RecordingFailed if the disk fails.
    """
    target = path.with_name(REBUILT)
    for suffix in JOURNAL_FILES:
        target.with_name(target.name + suffix).unlink(missing_ok=True)
    journal = Journal.create(target, rig.recorded, len(rig.channels), rig.sample_rate)
    places: dict[tuple[int, int], tuple[int, int]] = {}  # block -> its length, its number
    found_marks: list[Mark] = []
    for suffix in ("", "-wal"):
        raw = raw_bytes(path.with_name(path.name + suffix))
        found_marks += marks(raw)
        for row in block_rows(raw):
            _keep(journal, _as_block(row.values, rig), row.number, places)
    for values in itertools.chain(_rows_by_number(path), _tail_rows(path)):
        _keep(journal, _as_block(values, rig), int(values[0]), places)
    chosen = best_marks(found_marks)
    for mark in chosen:
        number = journal.begin_mark(mark.stream, mark.start, mark.meta)
        if mark.state != "open" and mark.ticks is not None:
            journal.end_mark(number, mark.ticks, mark.state, mark.meta)
    journal.in_order()
    return journal, _account(path.parent, places, chosen)


def _keep(
    journal: Journal,
    block: Block | None,
    number: int | None,
    places: dict[tuple[int, int], tuple[int, int]],
) -> None:
    if block is None:
        return
    key = (block.stream, block.tick)
    if key not in places:
        sample_block = SampleBlock(
            block.sequence, block.tick, block.data, block.saturated, 0, False
        )
        journal.append(block.stream, sample_block, block.late)
        places[key] = (len(block.data), number or 0)


def _tail_rows(path: Path) -> list[BlockRow]:
    try:
        return read_tail(path, after=0)
    except OSError as error:
        log.info("%s: %s", tail_of(path), error)
        return []


def _rows_by_number(path: Path) -> Iterator[tuple[Any, ...]]:
    """Yield the rows that SQLite can read, in groups, and one by one around a fault."""
    sql = (
        "SELECT id, stream, sequence, tick, samples, late, crc, data, saturated FROM block "
        "WHERE id BETWEEN ? AND ?"
    )
    try:
        with closing(_open(path)) as db:
            (highest,) = db.execute("SELECT max(id) FROM block").fetchone()
            for start in range(1, int(highest or 0) + 1, _AT_ONCE):
                for row in _readable(db, sql, start, start + _AT_ONCE - 1):
                    yield tuple(row)
    except _UNREADABLE as error:
        log.info("%s: %s", path, error)


def _readable(db: sqlite3.Connection, sql: str, first: int, last: int) -> list[tuple[Any, ...]]:
    try:
        return db.execute(sql, (first, last)).fetchall()
    except _UNREADABLE:
        if first == last:
            return []
        middle = (first + last) // 2
        return [*_readable(db, sql, first, middle), *_readable(db, sql, middle + 1, last)]


def _account(
    folder: Path, places: dict[tuple[int, int], tuple[int, int]], chosen: Sequence[Mark]
) -> Salvage:
    """Count the samples present and those known to be missing."""
    events = read_events(folder)
    names = {str(mark.meta["name"]) for mark in chosen}
    begun = {str(e["record"]) for e in events if e.get("event") == "record begins"}
    if not places:
        return Salvage(0, 0, 0, 0, tuple(sorted(begun - names)))
    keys = sorted(places)
    ticks = np.array([key[1] for key in keys], dtype=np.int64)
    streams = np.array([key[0] for key in keys], dtype=np.int64)
    ends = ticks + np.array([places[key][0] for key in keys], dtype=np.int64)
    gaps = np.where(streams[1:] == streams[:-1], ticks[1:] - ends[:-1], 0)
    wire = sum(int(e["lost"]) for e in events if isinstance(e.get("lost"), int))
    lost = max(0, int(gaps[gaps > 0].sum()) - wire)
    block_length = int(np.median(ends - ticks))
    numbers = sorted(number for _, number in places.values() if number)
    lost_blocks = 0 if not numbers else max(0, numbers[-1] - len(places))
    if numbers and places[keys[0]][1] > 1:
        lost += (places[keys[0]][1] - 1) * block_length
    # A mark may be written before the record's first sample.
    other_events = [e for e in events if e.get("event") != "record begins"]
    known = [int(e["tick"]) for e in other_events if isinstance(e.get("tick"), int)]
    known += [m.start + m.ticks for m in chosen if m.state == "complete" and m.ticks is not None]
    lost += max(0, max(known, default=0) - int(ends[-1]))
    return Salvage(
        len(places), int((ends - ticks).sum()), lost, lost_blocks, tuple(sorted(begun - names))
    )


def move_aside(path: Path) -> Path:
    """Rename a damaged journal and its log to an unused name; return the name."""
    number, target = 1, path.with_name(f"{DAMAGED}.sqlite")
    while target.exists() or target.with_name(target.name + "-wal").exists():
        number += 1
        target = path.with_name(f"{DAMAGED}-{number}.sqlite")
    # The database first: without it the run counts as finalised.
    for suffix in JOURNAL_FILES:
        source = path.with_name(path.name + suffix)
        if suffix == "-shm":
            source.unlink(missing_ok=True)
        elif source.exists():
            source.replace(target.with_name(target.name + suffix))
    sync_to_disk(path.parent)
    return target
