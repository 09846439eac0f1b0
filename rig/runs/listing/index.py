"""An index of a folder's runs, so that only changed run folders are read again.

The index is a cache: if it is deleted, damaged or outdated, it is rebuilt from the folders. A run
in progress, or one that cannot be read, is never read from it.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Final

from rig.runs.listing.summary import RunSummary, in_order, run_folders, summarise
from rig.runs.runstate import EVENTS, HEADER, JOURNAL, RUNNING
from rig.runs.store import ARCHIVE, is_run

log = logging.getLogger(__name__)

INDEX: Final = ".bramah-runs.sqlite"
_VERSION = 2
_SCHEMA = """
CREATE TABLE IF NOT EXISTS run (
    name TEXT PRIMARY KEY, signature TEXT NOT NULL, state TEXT NOT NULL, rig TEXT NOT NULL,
    protocol TEXT NOT NULL, created TEXT NOT NULL, samples INTEGER NOT NULL, line TEXT NOT NULL)
"""
_WATCHED = (HEADER, "state", "owner.json", EVENTS, ARCHIVE, JOURNAL)


def _signature(folder: Path) -> str:
    """Return sizes and times of a run's files, which change with the run."""
    parts: list[object] = []
    for name in _WATCHED:
        try:
            about = (folder / name).stat()
            parts += [about.st_size, about.st_mtime_ns]
        except OSError:
            parts += [None]
    return json.dumps(parts)


def _open(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, timeout=5.0)
    try:
        version = int(db.execute("PRAGMA user_version").fetchone()[0])
        if version != _VERSION:
            db.execute("DROP TABLE IF EXISTS run")
            db.execute(f"PRAGMA user_version={_VERSION}")
        db.execute(_SCHEMA)
    except sqlite3.Error:
        db.close()
        raise
    return db


def _line(summary: RunSummary) -> str:
    return json.dumps({**asdict(summary), "path": summary.path.name})


def _summary(folder: Path, line: str) -> RunSummary:
    return RunSummary(**{**json.loads(line), "path": folder})


def rebuild(root: Path) -> int:
    """Rebuild a folder's index from the run folders; return their number.

    Raises InputError if the folder cannot be read; logs an index that cannot be written.
    """
    for suffix in ("", "-journal", "-wal", "-shm"):
        root.joinpath(INDEX + suffix).unlink(missing_ok=True)
    return len(indexed_runs(root))


def indexed_runs(root: Path) -> list[RunSummary]:
    """List the runs in a folder, oldest first, unchanged ones from its index; raises InputError."""
    folders = run_folders(root)
    if is_run(root):
        return [summarise(root)]
    path = root / INDEX
    for attempt in (1, 2):
        try:
            with closing(_open(path)) as db:
                return in_order(_read(db, folders))
        except (sqlite3.Error, ValueError, TypeError) as error:
            if attempt == 1 and isinstance(error, (sqlite3.DatabaseError, ValueError, TypeError)):
                log.info("%s: index rebuilt: %s", path, error)
                if not _removed(path):
                    break
    return in_order([summarise(folder) for folder in folders])


def _removed(path: Path) -> bool:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:  # a read-only folder is listed without an index
        log.info("%s: %s", path, error)
        return False
    return True


def _read(db: sqlite3.Connection, folders: list[Path]) -> list[RunSummary]:
    stored = {name: (signature, line) for name, signature, line in
            db.execute("SELECT name, signature, line FROM run")}  # fmt: skip
    summaries, changed = [], []
    for folder in folders:
        signature = _signature(folder)
        entry = stored.get(folder.name)
        if entry is not None and entry[0] == signature:
            summaries.append(_summary(folder, entry[1]))
            continue
        summary = summarise(folder)
        summaries.append(summary)
        # The writer of a running one may die without changing a file, and what cannot be read may
        # become readable: rights and a restored copy change neither size nor time.
        if summary.state != RUNNING and summary.records >= 0:
            changed.append((signature, summary))
    removed = set(stored) - {folder.name for folder in folders}
    if changed or removed:
        _write(db, changed, removed)
    return summaries


def _write(
    db: sqlite3.Connection, changed: list[tuple[str, RunSummary]], removed: set[str]
) -> None:  # fmt: skip
    db.execute("BEGIN IMMEDIATE")
    db.executemany("DELETE FROM run WHERE name = ?", [(name,) for name in removed])
    db.executemany(
        "INSERT OR REPLACE INTO run VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        [
            (s.path.name, signature, s.state, s.rig, s.protocol, s.created, s.samples, _line(s))
            for signature, s in changed
        ],
    )
    db.execute("COMMIT")
