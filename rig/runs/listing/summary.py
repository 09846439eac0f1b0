"""One line for a run folder: state, rig, protocol and contents."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rig.model.parse import InputError
from rig.runs.journal import read_tail
from rig.runs.runstate import INTERRUPTED, JOURNAL, RUNNING, read_events, read_state
from rig.runs.sections import Written
from rig.runs.store import ARCHIVE, is_crate, is_run, missing_samples, read_header

UNREADABLE: Final = "unreadable"
_UNKNOWN = Written(-1, 0, -1, 0, 0, -1)


@dataclass(frozen=True)
class RunSummary:
    """One line of a list of runs; unknown counts are -1.

    Counts: complete `records`, incomplete ones (`partial`), `samples` within records,
    `lost_samples` missing in them, samples `outside` records. `seconds` is the device time of all
    samples. `recovered`: `recover` has finalised the run after its process died.
    """

    path: Path
    state: str
    rig: str
    protocol: str
    created: str
    records: int
    message: str
    partial: int = 0
    samples: int = -1
    lost_samples: int = 0
    outside: int = -1
    seconds: float = -1.0
    recovered: bool = False
    operator: str = ""


def summarise(folder: Path) -> RunSummary:
    """Summarise one run; never raises: the summary's message states what cannot be read."""
    try:
        header = read_header(folder)
    except InputError as error:
        return RunSummary(folder, UNREADABLE, "", "", "", -1, str(error))
    state = read_state(folder)
    events = read_events(folder)
    recovered, message = _end_of_run(events, state, folder)
    counted = _UNKNOWN
    try:
        counted = _count(folder, events)
    except (InputError, OSError, sqlite3.Error) as error:
        message = f"{message}; {error}".removeprefix("; ")
    total = counted.samples + counted.lost_samples + counted.outside
    is_known = counted.samples >= 0
    return RunSummary(
        path=folder,
        state=state,
        rig=header.rig.name,
        protocol=str((header.protocol or {}).get("name", "")) or header.source,
        created=header.created,
        records=counted.records - counted.partial if is_known else -1,
        message=message,
        partial=counted.partial,
        samples=counted.samples,
        lost_samples=counted.lost_samples,
        outside=counted.outside,
        seconds=total / header.rig.sample_rate if is_known else -1.0,
        recovered=recovered,
        operator=header.operator,
    )


def _end_of_run(events: list[dict[str, Any]], state: str, folder: Path) -> tuple[bool, str]:
    """Return whether a run was recovered, and the message of its latest end."""
    ends = [e for e in events if e.get("event") in ("end", "recovered")]
    has_journal = (folder / JOURNAL).exists()
    if state != RUNNING and has_journal:
        return False, f"finalise it with `bramah recover {folder}`"
    recovered = any(e["event"] == "recovered" for e in ends)
    if state == INTERRUPTED and not ends:
        return False, f"finalise it with `bramah recover {folder}`"
    message = str(ends[-1].get("message", "")) if ends else ""
    is_last = bool(ends) and ends[-1]["event"] == "recovered"
    return recovered, f"recovered: {message}" if is_last else message


def _count(folder: Path, events: list[dict[str, Any]]) -> Written:
    """Count the contents of a run; raises InputError where the file of its samples is missing."""
    archive, journal = folder / ARCHIVE, folder / JOURNAL
    if journal.exists():
        return _count_journal(journal)
    if not archive.exists():
        if missing := missing_samples(events):
            raise InputError(missing)
        return Written(0, 0, 0, 0, 0)
    from rig.runs.archive_reader import count  # noqa: PLC0415 - h5py loads slowly

    return count(archive)


def _count_journal(path: Path) -> Written:
    """Count the contents of a journal, even one being written; raises sqlite3.Error or OSError."""
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True, timeout=5.0)) as db:
        blocks = db.execute("SELECT stream, tick, samples, id FROM block").fetchall()
        marks = db.execute(
            "SELECT stream, start, ticks, state FROM mark WHERE state != 'discarded'"
        ).fetchall()
    tail = read_tail(path, after=max((number for *_, number in blocks), default=0))
    blocks += [(row.stream, row.tick, row.samples, row.id) for row in tail]
    inside = lost = 0
    for stream, start, ticks, _ in marks:
        block_ends = [tick + count for number, tick, count, _ in blocks if number == stream]
        end = max(block_ends, default=start) if ticks is None else start + ticks
        present = sum(
            max(0, min(end, tick + count) - max(start, tick))
            for number, tick, count, _ in blocks
            if number == stream
        )
        inside, lost = inside + present, lost + max(0, end - start - present)
    total = sum(count for _, _, count, _ in blocks)
    partial = sum(state != "complete" for *_, state in marks)
    return Written(len(marks), partial, inside, lost, 0, total - inside)


def run_folders(folder: str | Path) -> list[Path]:
    """Return the run folders in a folder, or itself if it is one; raises InputError.

    The copy of a run as an RO-Crate is not listed beside other runs: it would count twice.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    try:
        # A hidden folder is an incomplete one whose process was killed.
        if is_run(root):
            return [root]
        return [c for c in root.glob("[!.]*") if is_run(c) and not is_crate(c)]
    except OSError as error:
        raise InputError(f"{root}: cannot be read: {error.strerror}") from error


def crates(folder: str | Path) -> list[Path]:
    """Return the RO-Crates in a folder of runs, none where the folder itself is a run."""
    root = Path(folder)
    return [] if is_run(root) else sorted(c for c in root.glob("[!.]*") if is_crate(c))


def in_order(summaries: list[RunSummary]) -> list[RunSummary]:
    """Return summaries oldest first."""
    return sorted(summaries, key=lambda s: (s.created, s.path.name))
