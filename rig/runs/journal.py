"""The journal of a run: every block, checksummed, in SQLite; the newest in a memory-mapped file.

A block is acknowledged when `append` returns; it then survives the death of the process at any
moment. The newest blocks are in the *tail*, a small mapped file: written without a system call,
because a transaction for each block takes a quarter of the host's processor time. A full tail moves
into the database in one transaction, which its write-ahead log keeps whole or drops whole.

Glossary: a *stream* is an unbroken count of device ticks (a restart of the device's streaming
begins another); a *mark* says that a tick range of a stream is a record.
"""

from __future__ import annotations

import json
import logging
import math
import mmap
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

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


JOURNAL_FILES: Final = ("", "-wal", "-shm", "-tail")  # behind the journal's name
TAIL_BLOCKS: Final = 32  # moved into the database at once
TAIL_BYTES: Final = 1 << 16
_ENTRY = struct.Struct("<4sII")  # begin, length of the body, its checksum
ENTRY_BEGIN: Final = b"BLK1"
_NUMBERS = struct.Struct("<5qdII")  # id, stream, sequence, tick, samples, late, checksum, length

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


class BlockRow(NamedTuple):
    """A block as a row of the table; `data` holds (samples, columns) as little-endian float64."""

    id: int
    stream: int
    sequence: int
    tick: int
    samples: int
    late: float | None
    crc: int
    data: bytes
    saturated: bytes


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


class JournalTail:
    """The newest blocks of a journal in a mapped file, which keeps them when the process dies."""

    def __init__(self, path: Path) -> None:
        with path.open("w+b") as file:
            file.write(bytes(TAIL_BYTES))  # a mapped page without disk space would kill the process
            file.flush()
            self._map = mmap.mmap(file.fileno(), TAIL_BYTES)
        self._end = 0

    def add(self, row: BlockRow) -> bool:
        """Write a row behind the others; return False if it has no room."""
        body = _NUMBERS.pack(
            *row[:5], math.nan if row.late is None else row.late, row.crc, len(row.data)
        )
        body += row.data + row.saturated
        entry = _ENTRY.pack(ENTRY_BEGIN, len(body), zlib.crc32(body)) + body
        end = self._end + len(entry)
        if end > TAIL_BYTES:
            return False
        self._map[self._end : end] = entry
        self._end = end
        return True

    def clear(self) -> None:
        """Begin at the first place again; `read_tail` leaves out older rows by their numbers."""
        self._end = 0

    def close(self) -> None:
        """Close the file; its rows stay."""
        self._map.close()


def tail_of(path: Path) -> Path:
    """Return the path of the tail of a journal."""
    return path.with_name(f"{path.name}-tail")


def read_tail(path: Path, after: int) -> list[BlockRow]:
    """Return the rows with numbers above `after` in the tail of the journal `path`, in order.

    A row whose checksum fails is left out. Raises OSError.
    """
    tail = tail_of(path)
    data = tail.read_bytes() if tail.is_file() else b""
    rows = (row for _, row in entries(data[:TAIL_BYTES]))
    return sorted(row for row in rows if row is not None and row.id > after)


def entry_bytes(size: int) -> int:
    """Return the bytes in a tail of a row with `size` bytes of samples and marks."""
    return _ENTRY.size + _NUMBERS.size + size


def entries(data: bytes) -> Iterator[tuple[int, BlockRow | None]]:
    """Yield (where it ends, row) of the entries from the begin of `data` on.

    The row is None where its checksum fails.
    """
    offset = 0
    while offset + _ENTRY.size <= len(data):
        begin, length, crc = _ENTRY.unpack_from(data, offset)
        body = data[offset + _ENTRY.size : offset + _ENTRY.size + length]
        if begin != ENTRY_BEGIN or not _NUMBERS.size <= len(body) == length:
            return
        offset += _ENTRY.size + length
        if zlib.crc32(body) != crc:
            yield offset, None
            continue
        *numbers, late, block_crc, size = _NUMBERS.unpack_from(body)
        samples, marks = body[_NUMBERS.size :][:size], body[_NUMBERS.size + size :]
        yield (
            offset,
            BlockRow._make(
                (*numbers, None if math.isnan(late) else late, block_crc, samples, marks)
            ),
        )


class Journal:
    """One open journal: `create` to write, `open` to read; RecordingFailed if a write fails."""

    def __init__(
        self, connection: sqlite3.Connection, path: Path, tail: JournalTail | None = None
    ) -> None:
        self._db = connection
        self.path = path
        self._next_mark = 1
        self._tail = tail
        self._newest: list[BlockRow] = []  # not yet in the database
        self._count = 0

    @classmethod
    def create(
        cls, path: Path, columns: Sequence[str], measured: int, sample_rate: float
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
            tail = JournalTail(tail_of(path))
            fresh.replace(path)
            db = sqlite3.connect(path, isolation_level=None)
            # NORMAL: a kill loses nothing, a power cut at most the blocks since the last sync;
            # FULL would delay the acquisition by a disk sync per transaction.
            db.execute("PRAGMA synchronous=NORMAL")
        except (sqlite3.Error, OSError) as error:
            raise RecordingFailed(
                f"{path}: the journal cannot be written ({error}; is the disk full?)"
            ) from error
        return cls(db, path, tail)

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
            (highest,) = db.execute("SELECT max(id) FROM block").fetchone()
            journal._newest = read_tail(path, after=int(highest or 0))
        except (sqlite3.Error, OSError) as error:
            raise InputError(
                f"{path}: not a readable journal ({error}; is the disk full, or the file another "
                "user's?)"
            ) from error
        return journal

    def _write(self, sql: str, values: tuple[Any, ...]) -> None:
        with self._failing():
            self._db.execute(sql, values)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Raise RecordingFailed for an error of the database."""
        try:
            yield
        except sqlite3.Error as error:
            raise RecordingFailed(
                f"{self.path}: cannot be written ({error}; is the disk full?); the blocks "
                "recorded before are kept"
            ) from error

    def append(self, stream: int, block: SampleBlock, late: float | None) -> None:
        """Write one block (samples as float64) safely; raises RecordingFailed."""
        if self._tail is None:
            raise RecordingFailed(f"{self.path}: is open for reading only")
        data = np.ascontiguousarray(block.data, dtype="<f8").tobytes()
        marked = np.count_nonzero(block.saturated)
        marks = np.packbits(block.saturated).tobytes() if marked else b""
        crc = _checksum(stream, block.sequence, block.tick, data, marks)
        self._count += 1
        numbers = (self._count, stream, block.sequence, block.tick, len(block.data))
        row = BlockRow(*numbers, late, crc, data, marks)
        stored = self._tail.add(row)
        if not stored:
            self.flush()
            stored = self._tail.add(row)
        self._newest.append(row)
        if not stored or len(self._newest) >= TAIL_BLOCKS:
            self.flush()

    def require_folder(self) -> None:
        """Raise RecordingFailed if the run folder was deleted or moved: SQLite does not notice."""
        if not self.path.exists():
            raise RecordingFailed(
                f"{self.path.parent}: this run folder was deleted or moved during the run, which "
                f"ends with its outputs at zero; its {self.spans().samples.sum()} samples are lost "
                "if it was deleted; if it was moved, `bramah recover` it at its new place"
            )

    def flush(self) -> None:
        """Move the tail's blocks into the database; after RecordingFailed they are in the tail.

        Raises as `require_folder`.
        """
        with self._failing(), self._db:
            self._db.execute("BEGIN")
            self._db.executemany(
                "INSERT INTO block VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", self._newest
            )
        self._newest = []
        if self._tail is not None:
            self._tail.clear()
        self.require_folder()

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
        spans: list[tuple[int, int, int, int]] = []
        rows = self._db.execute("SELECT id, stream, tick, samples FROM block ORDER BY id")
        try:
            spans.extend(rows)
        except sqlite3.DatabaseError as error:  # a damaged page: keep the blocks before it
            log.warning("%s: unreadable after %d blocks: %s", self.path, len(spans), error)
        spans.extend((row.id, row.stream, row.tick, row.samples) for row in self._newest)
        table = np.array(spans, dtype=np.int64).reshape(len(spans), 4)
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
        for row in self._newest:
            if first <= row.id <= last:
                yield row.id, decode_row(row[1:], columns, measured)

    def in_order(self) -> None:
        """Renumber the blocks in order of stream and tick; raises RecordingFailed."""
        self.flush()
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
        if self._tail is not None:
            self._tail.close()

    def delete(self) -> None:
        """Close and remove the journal with its write-ahead log."""
        self.close()
        for suffix in JOURNAL_FILES:
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
