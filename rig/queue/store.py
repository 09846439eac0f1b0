"""The queue on disk: one SQLite file; every change and its history line are one transaction."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

from rig.model.parse import InputError
from rig.queue.items import (
    ACTIVE,
    CANCELLED,
    CHECKING,
    OVER,
    QUEUED,
    RUNNING,
    Item,
    QueueJob,
    require_one_line,
)
from rig.runs.runstate import utc_now

SCHEMA_VERSION: Final = 1
_PATIENCE = 20.0  # [s] to wait for another process that has locked the file
_SCHEMA = """
CREATE TABLE IF NOT EXISTS item (
    id INTEGER PRIMARY KEY AUTOINCREMENT, priority INTEGER NOT NULL, place REAL NOT NULL,
    state TEXT NOT NULL, reason TEXT NOT NULL, job TEXT NOT NULL,
    attempt INTEGER NOT NULL DEFAULT 0, run TEXT NOT NULL DEFAULT '', pid INTEGER,
    cancel INTEGER NOT NULL DEFAULT 0, added TEXT NOT NULL, started TEXT NOT NULL DEFAULT '',
    ended TEXT NOT NULL DEFAULT '', proof TEXT NOT NULL, found TEXT NOT NULL DEFAULT '{}');
CREATE TABLE IF NOT EXISTS history (
    id INTEGER PRIMARY KEY AUTOINCREMENT, time TEXT NOT NULL, item INTEGER, attempt INTEGER,
    event TEXT NOT NULL, reason TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS setting (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
"""
_COLUMNS = (
    "id, priority, place, state, reason, job, attempt, run, pid, cancel, added, started, ended, "
    "proof, found"
)
_PAUSE = "pause"


@dataclass(frozen=True)
class QueueLine:
    """One line of the history; `event` is an item's new state or an action of the queue."""

    time: str
    item: int | None
    attempt: int | None
    event: str
    reason: str


def _item_of(row: Sequence[Any]) -> Item:
    (number, priority, place, state, reason, job, attempt, run, pid, cancel) = row[:10]
    added, started, ended, proof, results = row[10:]
    return Item(
        number, priority, place, state, reason, QueueJob.from_dict(json.loads(job)), attempt, run,
        pid, bool(cancel), added, started, ended, json.loads(proof), json.loads(results),
    )  # fmt: skip


class QueueStore:
    """One open queue file, which several processes can use.

    Raises InputError for a file that is not a queue, or of a later version.
    """

    def __init__(self, path: Path, *, create: bool = True) -> None:
        self.path = path
        if not create and not path.exists():
            raise InputError(f"{path}: no such queue; `bramah queue add` creates it")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, isolation_level=None, timeout=_PATIENCE)
        except (OSError, sqlite3.Error) as error:
            raise InputError(f"{path}: cannot be opened as a queue: {error}") from error
        with self._readable():
            self._prepare()

    def _prepare(self) -> None:
        version = self._version()
        if version > SCHEMA_VERSION:
            self._db.close()
            raise InputError(
                f"{self.path}: a queue of schema version {version}; this version of bramah reads "
                f"up to {SCHEMA_VERSION}: update bramah"
            )
        if version == 0 and self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            self._db.close()
            raise InputError(f"{self.path}: a database of another program; expected a queue")
        self._db.execute("PRAGMA journal_mode=WAL")
        # Every change must be on disk before any action that depends on it.
        self._db.execute("PRAGMA synchronous=FULL")
        if version == SCHEMA_VERSION:
            return
        with self._transaction():
            for statement in _SCHEMA.split(";"):
                self._db.execute(statement)
            self._db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")

    def _version(self) -> int:
        return int(self._db.execute("PRAGMA user_version").fetchone()[0])

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise InputError(f"{self.path}: not a usable queue: {error}") from error

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._readable():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    # Reading

    def items(self) -> list[Item]:
        """Return every item in the order in which they start."""
        with self._readable():
            rows = self._db.execute(
                f"SELECT {_COLUMNS} FROM item ORDER BY priority DESC, place, id"
            )
            return [_item_of(row) for row in rows]

    def item(self, number: int) -> Item:
        """Return one item; raises InputError."""
        with self._readable():
            row = self._db.execute(
                f"SELECT {_COLUMNS} FROM item WHERE id = ?", (number,)
            ).fetchone()
        if row is None:
            numbers = [item.id for item in self.items()]
            items = f"items {min(numbers)} to {max(numbers)}" if numbers else "no items"
            raise InputError(f"{self.path}: no item {number}; the queue has {items}")
        return _item_of(row)

    def history(self, number: int | None = None) -> list[QueueLine]:
        """Return the history of an item, or of the whole queue, oldest first."""
        where = "" if number is None else "WHERE item = ?"
        values = () if number is None else (number,)
        sql = f"SELECT time, item, attempt, event, reason FROM history {where} ORDER BY id"
        with self._readable():
            return [QueueLine(*row) for row in self._db.execute(sql, values)]

    @property
    def paused(self) -> str:
        """Who paused the queue and when; '' if it is not paused."""
        with self._readable():
            row = self._db.execute("SELECT value FROM setting WHERE key = ?", (_PAUSE,)).fetchone()
        return "" if row is None else str(row[0])

    # Changes by the user

    def add(self, job: QueueJob, priority: int, proof: dict[str, Any]) -> Item:
        """Add an item as the last of its priority; raises InputError for a name of two lines."""
        require_one_line(job.name, "--name")
        with self._transaction():
            if job.after is not None:
                self.item(job.after)
            self._refuse_taken(job.out)
            place = self._db.execute("SELECT coalesce(max(place), 0) + 1 FROM item").fetchone()[0]
            number = self._db.execute(
                "INSERT INTO item (priority, place, state, reason, job, added, proof) "
                "VALUES (?, ?, ?, '', ?, ?, ?)",
                (priority, place, QUEUED, json.dumps(asdict(job)), utc_now(), json.dumps(proof)),
            ).lastrowid
            assert number is not None
            self._note(number, 0, QUEUED, "added")
        return self.item(number)

    def _refuse_taken(self, out: str) -> None:
        for item in self.items():
            if out in (item.job.out, item.run):
                raise InputError(
                    f"--out {out}: is already the run folder of item {item.id}; name another"
                )

    def next_number(self) -> int:
        """Return the number of the next item, unless another process adds one first."""
        with self._readable():
            row = self._db.execute("SELECT seq FROM sqlite_sequence WHERE name = 'item'").fetchone()
        return 1 if row is None else int(row[0]) + 1

    def move(self, number: int, *, before: int | None = None, last: bool = False,
             priority: int | None = None) -> Item:  # fmt: skip
        """Move a waiting item: before another (taking its priority), to an end, or to a priority.

        Without `before` and `last` it becomes the first of its priority. Raises InputError.
        """
        with self._transaction():
            item = self.item(number)
            if item.state != QUEUED:
                raise InputError(f"item {number} is {item.state}; only a queued item can be moved")
            if before == number:
                raise InputError(f"item {number}: --before names the item itself")
            successor = None if before is None else self.item(before)
            rank = item.priority if priority is None else priority
            rank = successor.priority if successor else rank
            peers = [i for i in self.items() if i.priority == rank and i.id != number]
            index = len(peers) if last else 0
            if successor is not None:
                index = next(k for k, peer in enumerate(peers) if peer.id == successor.id)
            order = [*peers[:index], item, *peers[index:]]
            for place, peer in enumerate(order, start=1):
                self._db.execute(
                    "UPDATE item SET place = ?, priority = ? WHERE id = ?", (place, rank, peer.id)
                )
            self._note(number, item.attempt, "moved", f"priority {rank}, place {index + 1}")
        return self.item(number)

    def cancel(self, number: int, who: str) -> Item:
        """Cancel a waiting item, or request the end of a running one; raises InputError."""
        with self._transaction():
            item = self.item(number)
            if item.over:
                raise InputError(f"item {number} is {item.state} already")
            if item.state == QUEUED:
                self._enter(item, CANCELLED, f"cancelled by {who}")
            else:
                self._db.execute("UPDATE item SET cancel = 1 WHERE id = ?", (number,))
                self._note(number, item.attempt, "cancel requested", f"by {who}")
        return self.item(number)

    def retry(self, number: int, who: str) -> Item:
        """Queue an ended item again, at its place, for a person; raises InputError."""
        with self._transaction():
            item = self.item(number)
            if not item.over:
                raise InputError(f"item {number} is {item.state}; expected an item that has ended")
            self._db.execute(
                "UPDATE item SET cancel = 0, ended = '', found = '{}' WHERE id = ?", (number,)
            )
            self._enter(item, QUEUED, f"queued again by {who}; it was {item.state}")
        return self.item(number)

    def pause(self, who: str) -> None:
        """Start no further item until `resume`."""
        with self._transaction():
            text = f"paused by {who} at {utc_now()}"
            self._db.execute("INSERT OR REPLACE INTO setting VALUES (?, ?)", (_PAUSE, text))
            self._note(None, None, "paused", f"by {who}")

    def resume(self, who: str) -> None:
        """Lift a pause."""
        with self._transaction():
            self._db.execute("DELETE FROM setting WHERE key = ?", (_PAUSE,))
            self._note(None, None, "pause lifted", f"by {who}")

    # Changes by the runner

    def claim(self, number: int) -> Item | None:
        """Take a queued item for its check; None if it is not queued or the queue is paused."""
        with self._transaction():
            item = self.item(number)
            if item.state != QUEUED or self.paused:
                return None
            self._db.execute("UPDATE item SET started = ? WHERE id = ?", (utc_now(), number))
            self._enter(item, CHECKING, "")
        return self.item(number)

    def begin(self, number: int) -> Item:
        """Enter `running` with the next attempt's folder, before its process; raises InputError."""
        with self._transaction():
            item = self.item(number)
            if item.state != CHECKING:
                raise InputError(f"item {number} is {item.state}; expected a checked item")
            self._db.execute(
                "UPDATE item SET attempt = attempt + 1, run = ?, pid = NULL WHERE id = ?",
                (item.next_folder(), number),
            )
            self._enter(self.item(number), RUNNING, "")
        return self.item(number)

    def note_process(self, number: int, pid: int) -> None:
        """Store the id of an item's process."""
        with self._transaction():
            self._db.execute("UPDATE item SET pid = ? WHERE id = ?", (pid, number))

    def finish(self, number: int, state: str, reason: str) -> Item:
        """Set an item's final state, unless it has one; raises ValueError for another state."""
        if state not in OVER:
            raise ValueError(f"{state!r} is not a final state")
        with self._transaction():
            item = self.item(number)
            if not item.over:
                self._enter(item, state, reason)
        return self.item(number)

    def release(self, number: int, reason: str) -> Item:
        """Queue an item again whose protocol did not begin: no motion and no record."""
        with self._transaction():
            item = self.item(number)
            if item.state == RUNNING:  # the next attempt uses the same folder
                self._db.execute("UPDATE item SET attempt = attempt - 1 WHERE id = ?", (number,))
            if item.state in ACTIVE:
                self._enter(self.item(number), QUEUED, reason)
        return self.item(number)

    def keep_results(self, number: int, results: dict[str, Any]) -> None:
        """Store the parameters identified from an item's run."""
        with self._transaction():
            self._db.execute(
                "UPDATE item SET found = ? WHERE id = ?", (json.dumps(results), number)
            )

    def note(self, event: str, reason: str = "") -> None:
        """Add an action of the queue to the history."""
        with self._transaction():
            self._note(None, None, event, reason)

    def _enter(self, item: Item, state: str, reason: str) -> None:
        ended = ", ended = ?" if state in OVER else ""
        values = [state, reason, *([utc_now()] if ended else []), item.id]
        self._db.execute(f"UPDATE item SET state = ?, reason = ?{ended} WHERE id = ?", values)
        if state not in ACTIVE:
            self._db.execute("UPDATE item SET pid = NULL WHERE id = ?", (item.id,))
        self._note(item.id, item.attempt, state, reason)

    def _note(self, number: int | None, attempt: int | None, event: str, reason: str) -> None:
        self._db.execute(
            "INSERT INTO history (time, item, attempt, event, reason) VALUES (?, ?, ?, ?, ?)",
            (utc_now(), number, attempt, event, reason),
        )
