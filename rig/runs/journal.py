"""The journal of a run: every block, checksummed, in SQLite's write-ahead log.

A block is acknowledged when `append` returns; it then survives the death of the process at any
moment (the write-ahead log drops a torn transaction whole, the checksum finds a damaged blob).

Glossary: a *stream* is an unbroken count of device ticks (a restart of the device's streaming
begins another); a *mark* says that a tick range of a stream is a record.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.model.parse import InputError
from rig.model.trips import RecordingFailed

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Ticks = NDArray[np.int64]

_FORMAT = 1
_LAST = (1 << 63) - 1  # the largest number SQLite gives a row
_BLOCKS = """
CREATE TABLE block (
    id INTEGER PRIMARY KEY, stream INTEGER NOT NULL, sequence INTEGER NOT NULL,
    tick INTEGER NOT NULL, samples INTEGER NOT NULL, late REAL, crc INTEGER NOT NULL,
    data BLOB NOT NULL, saturated BLOB NOT NULL)
"""
_SCHEMA = f"""
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
{_BLOCKS};
CREATE TABLE mark (
    id INTEGER PRIMARY KEY, stream INTEGER NOT NULL, start INTEGER NOT NULL, ticks INTEGER,
    state TEXT NOT NULL, meta TEXT NOT NULL);
"""


# Keys of every record's description that the archive needs.
_DESCRIPTION: Final = frozenset(("name", "step", "repeat", "locked", "period", "lines"))


def describes_record(meta: Any) -> bool:
    """Return whether a mark's description has every key of a record's."""
    return isinstance(meta, dict) and _DESCRIPTION.issubset(meta)


@dataclass(frozen=True)
class Block:
    """A block of the journal; `late` [s] is None in virtual time."""

    stream: int
    sequence: int
    tick: int
    late: float | None
    data: Array
    saturated: NDArray[np.bool_]


@dataclass(frozen=True)
class Spans:
    """Stream, tick and length of blocks: one entry per block in order of arrival."""

    id: Ticks
    stream: Ticks
    tick: Ticks
    samples: Ticks


@dataclass(frozen=True)
class Mark:
    """A tick range of a stream that is a record; `ticks` is None while it is open."""

    id: int
    stream: int
    start: int
    ticks: int | None
    state: str
    meta: dict[str, Any] = field(default_factory=dict)


def _checksum(stream: int, sequence: int, tick: int, data: bytes, saturated: bytes) -> int:
    head = f"{stream} {sequence} {tick} {len(data)}".encode()
    return zlib.crc32(saturated, zlib.crc32(data, zlib.crc32(head)))


class Journal:
    """One open journal; `create` to write, `open` to read; a failed write raises RecordingFailed.

    `max_pages` bounds its size in pages of 4 KiB (for tests of a full disk).
    """

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._db = connection
        self.path = path
        self._next_mark = 1

    @classmethod
    def create(
        cls,
        path: Path,
        columns: Sequence[str],
        measured: int,
        sample_rate: float,
        max_pages: int | None = None,
    ) -> Journal:
        """Start the journal of `columns` (the first `measured` are sensors); RecordingFailed."""
        # Created under another name and renamed: a kill leaves no journal or a usable one.
        fresh = path.with_name(f"{path.name}.tmp")
        try:
            db = sqlite3.connect(fresh, isolation_level=None)
            meta = {
                "format": _FORMAT,
                "columns": list(columns),
                "measured": measured,
                "sample_rate": sample_rate,
            }
            db.executescript(_SCHEMA)
            rows = [(key, json.dumps(value)) for key, value in meta.items()]
            db.executemany("INSERT INTO meta VALUES (?, ?)", rows)
            db.execute("PRAGMA journal_mode=WAL")
            db.close()
            fresh.replace(path)
            db = sqlite3.connect(path, isolation_level=None)
            # NORMAL: a kill loses nothing, a power cut at most the blocks since the last sync;
            # FULL would delay the acquisition by a disk sync per block.
            db.execute("PRAGMA synchronous=NORMAL")
            if max_pages is not None:
                db.execute(f"PRAGMA max_page_count={int(max_pages)}")
        except (sqlite3.Error, OSError) as error:
            raise RecordingFailed(f"{path}: the journal cannot be written: {error}") from error
        return cls(db, path)

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal to read and finish it; raises InputError for other files."""
        if not path.is_file():
            raise InputError(f"{path}: no such journal")
        try:
            db = sqlite3.connect(path, isolation_level=None)
            journal = cls(db, path)
            if journal.meta("format") != _FORMAT:
                db.close()
                raise InputError(f"{path}: not a journal of this format")
        except sqlite3.Error as error:
            raise InputError(f"{path}: not a readable journal: {error}") from error
        return journal

    def _write(self, sql: str, values: tuple[Any, ...]) -> None:
        try:
            self._db.execute(sql, values)
        except sqlite3.Error as error:
            raise RecordingFailed(
                f"{self.path}: cannot be written ({error}; is the disk full?); the blocks "
                "recorded before are kept"
            ) from error

    def append(self, stream: int, block: SampleBlock, late: float | None) -> None:
        """Write one block (samples as float64) safely; raises RecordingFailed."""
        data = np.ascontiguousarray(block.data, dtype="<f8").tobytes()
        marked = np.count_nonzero(block.saturated)
        marks = np.packbits(block.saturated).tobytes() if marked else b""
        crc = _checksum(stream, block.sequence, block.tick, data, marks)
        values = (stream, block.sequence, block.tick, len(block.data), late, crc, data, marks)
        self._write("INSERT INTO block VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?)", values)

    def begin_mark(self, stream: int, start: int, meta: dict[str, Any]) -> int:
        """Open a mark at a tick; returns its number."""
        number = self._next_mark
        text = json.dumps(meta)
        self._write(
            "INSERT INTO mark VALUES (?, ?, ?, NULL, 'open', ?)", (number, stream, start, text)
        )
        self._next_mark += 1
        return number

    def end_mark(self, number: int, ticks: int, state: str, meta: dict[str, Any]) -> None:
        """Close a mark: `state` is complete, partial or discarded."""
        self._write(
            "UPDATE mark SET ticks = ?, state = ?, meta = ? WHERE id = ?",
            (ticks, state, json.dumps(meta), number),
        )

    def set_meta(self, key: str, value: Any) -> None:
        """Store one property of the run."""
        self._write("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, json.dumps(value)))

    def meta(self, key: str) -> Any:
        """Return a stored property, None if there is none."""
        row = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])

    def marks(self) -> list[Mark]:
        """Return all marks in the order they began."""
        rows = self._db.execute(
            "SELECT id, stream, start, ticks, state, meta FROM mark ORDER BY id"
        )
        return [
            Mark(number, stream, start, ticks, state, json.loads(meta))
            for number, stream, start, ticks, state, meta in rows
        ]

    def spans(self) -> Spans:
        """Return the spans of all readable blocks in order of arrival."""
        out: list[tuple[int, int, int, int]] = []
        rows = self._db.execute("SELECT id, stream, tick, samples FROM block ORDER BY id")
        try:
            out.extend(rows)
        except sqlite3.DatabaseError as error:  # a damaged page: keep the blocks before it
            log.warning("%s: unreadable after %d blocks: %s", self.path, len(out), error)
        table = np.array(out, dtype=np.int64).reshape(len(out), 4)
        return Spans(*table.T)

    def blocks(self, first: int = 0, last: int = _LAST) -> Iterator[tuple[int, Block | None]]:
        """Yield (id, block) in the order of arrival; None for a block whose checksum fails."""
        measured, columns = int(self.meta("measured")), len(self.meta("columns"))
        rows = self._db.execute(
            "SELECT id, stream, sequence, tick, samples, late, crc, data, saturated FROM block "
            "WHERE id BETWEEN ? AND ? ORDER BY id",
            (first, last),
        )
        with suppress(sqlite3.DatabaseError):  # reported by `spans`
            for row in rows:
                yield int(row[0]), decode_row(row[1:], columns, measured)

    def in_order(self) -> None:
        """Renumber the blocks in order of stream and tick; raises RecordingFailed."""
        rows = (
            "INSERT INTO block SELECT NULL, stream, sequence, tick, samples, late, crc, data, "
            "saturated FROM unordered ORDER BY stream, tick"
        )
        self._write("ALTER TABLE block RENAME TO unordered", ())
        self._write(_BLOCKS, ())
        self._write(rows, ())
        self._write("DROP TABLE unordered", ())

    def close(self) -> None:
        """Close the files; never raises."""
        with suppress(sqlite3.Error):
            self._db.close()

    def delete(self) -> None:
        """Close and remove the journal with its write-ahead log."""
        self.close()
        for suffix in ("", "-wal", "-shm"):
            self.path.with_name(self.path.name + suffix).unlink(missing_ok=True)


def decode_row(row: tuple[Any, ...], columns: int, measured: int) -> Block | None:
    """Return the block of a row (its columns behind the id), None if the checksum fails."""
    stream, sequence, tick, samples, late, crc, data, marks = row
    if not isinstance(data, bytes) or len(data) != samples * columns * 8:
        return None
    if _checksum(stream, sequence, tick, data, marks) != crc:
        return None
    values = np.frombuffer(data, dtype="<f8").reshape(samples, columns)
    bits = np.zeros(samples * measured, dtype=bool)
    if marks:
        packed = np.frombuffer(marks, dtype=np.uint8)
        bits = np.unpackbits(packed, count=samples * measured).astype(bool)
    return Block(stream, sequence, tick, late, values, bits.reshape(samples, measured))
