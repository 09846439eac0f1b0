"""Finalises a run whose process died at any moment."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed
from rig.runs import runstate, store
from rig.runs.journal import Journal
from rig.runs.recorder import finalise
from rig.runs.salvage.rebuild import CUT_OFF, find_damage, move_aside, rebuild
from rig.runs.sections import Written

log = logging.getLogger(__name__)
FINALISED: Final = "was finalised already; there is nothing to recover"


@dataclass(frozen=True, kw_only=True)
class RecoverReport(Written):
    """Result of `recover`: counts of the records, and messages to the user.

    `damaged` is the path of a damaged journal, from which at least `missing` samples are lost.
    """

    path: Path
    state: str
    message: str
    damaged: Path | None = None
    missing: int = 0


def recover(path: str | Path, *, force: bool = False) -> RecoverReport:
    """Finalise an interrupted run; repeating it changes nothing.

    The state becomes the final one that the run was about to set, or `interrupted`. `force`
    recovers a run of another computer, whose process cannot be checked. Raises InputError (not a
    run, or still running) and RecordingFailed (not writable, or journal unreadable). A damaged
    journal is never deleted: see `RecoverReport.damaged`.
    """
    folder = Path(path)
    header = store.read_header(folder)
    _refuse_if_alive(folder, force)
    try:
        if not (folder / runstate.JOURNAL).exists():
            return _without_journal(folder)
        state_before = runstate.read_state(folder)
        runstate.take_ownership(folder)
        try:
            report = _from_journal(folder, header.rig, state_before)
            from rig.runs.exchange.trip_window import write_trip_window  # noqa: PLC0415 - as h5py

            write_trip_window(folder)
            return report
        finally:
            runstate.release_ownership(folder)
    except OSError as error:
        raise RecordingFailed(f"{folder}: cannot be finalised: {error}") from error


def _refuse_if_alive(folder: Path, force: bool) -> None:
    owner = runstate.read_owner(folder)
    if owner is None:
        return
    if runstate.owner_alive(owner):
        raise InputError(
            f"{folder}: is being written by process {owner.pid}; stop that run first "
            "(`bramah monitor`, or Ctrl-C in its window)"
        )
    if owner.host != runstate.computer_name() and not force:
        raise InputError(
            f"{folder}: was being written on computer {owner.host!r}; recover it there, or with "
            "--force if that run is surely over"
        )


def _from_journal(folder: Path, rig: Rig, state_before: str) -> RecoverReport:
    _tidy(folder)
    path = folder / runstate.JOURNAL
    damage = find_damage(path, rig)
    if damage is not None:
        return _from_damaged(folder, rig, state_before, damage)
    journal = Journal.open(path)
    try:
        state = str(journal.meta("outcome") or state_before)
        written = finalise(journal, folder, rig.name, state)
    finally:
        journal.close()
    message = _counts(written)
    _note(folder, state, message)
    return _report(folder, state, written, message)


def _from_damaged(folder: Path, rig: Rig, state_before: str, damage: str) -> RecoverReport:
    """Finalise the readable part of a damaged or cut off journal and keep the journal."""
    path = folder / runstate.JOURNAL
    state = _outcome(path) or state_before
    journal, rebuilt = rebuild(path, rig)
    try:
        if not rebuilt.blocks:
            journal.delete()
            raise RecordingFailed(
                f"{path}: not a readable journal: {damage}; none of its blocks can be read. "
                "The file is unchanged: restore it from a backup, or repeat the run"
            )
        written = finalise(journal, folder, rig.name, state)
    finally:
        journal.close()
    damaged_journal = move_aside(path)
    seconds = rebuilt.lost / rig.sample_rate
    loss = f"lost: {rebuilt.lost} samples ({seconds:.3f} s)" if rebuilt.lost else "no loss is known"
    # A full disk cuts the last write off; every block before it is there.
    early = damage == CUT_OFF and not rebuilt.lost and not rebuilt.nameless
    ends_early = "ends early: its last write is cut off, as by a full disk"
    message = (
        f"the journal {ends_early if early else f'is damaged: {damage}'}; read from it: "
        f"{rebuilt.samples} samples; {loss}; what came after its last readable sample cannot be "
        f"counted; {_counts(written)}; the journal is kept as {damaged_journal.name}"
    )
    if rebuilt.nameless:
        message += (
            f"; the descriptions of these records are lost, their samples are under "
            f"{runstate.BETWEEN}: {', '.join(rebuilt.nameless)}"
        )
    _note(folder, state, message)
    report = _report(folder, state, written, message)
    damaged = None if early else damaged_journal
    return replace(
        report, damaged_blocks=rebuilt.lost_blocks, damaged=damaged, missing=rebuilt.lost
    )


def _outcome(path: Path) -> str | None:
    """Return the final state stored in a damaged journal, None if it cannot be read."""
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as db:
            outcome = Journal(db, path).meta("outcome")
    except (sqlite3.Error, ValueError, TypeError):
        return None
    return outcome if outcome in runstate.STATES else None


def _counts(written: Written) -> str:
    return (
        f"{written.records} record(s), {written.partial} of them unfinished, "
        f"{written.samples} samples in them, {written.lost_samples} lost; "
        f"{written.outside} samples outside of records"
    )


def _tidy(folder: Path) -> None:
    """Remove the temporary files of a killed process."""
    with suppress(OSError):  # a disk that cannot be written: what has to be written says so
        for stray in folder.glob("*.tmp*"):
            stray.unlink(missing_ok=True)


def _without_journal(folder: Path) -> RecoverReport:
    _tidy(folder)
    state = runstate.read_state(folder)
    archive = folder / store.ARCHIVE
    if not archive.exists():
        if missing := store.missing_samples(runstate.read_events(folder)):
            raise RecordingFailed(f"{folder}: {missing}")
        message = "nothing had been recorded"
        _end(folder, state)
        _note(folder, state, message)
        return _report(folder, state, Written(0, 0, 0, 0, 0), message)
    from rig.runs.archive_reader import count  # noqa: PLC0415 - h5py loads slowly

    written = count(archive)
    _end(folder, state)
    return _report(folder, state, written, FINALISED)


def _end(folder: Path, state: str) -> None:
    runstate.write_state(folder, state)
    with suppress(OSError):
        runstate.release_ownership(folder)


def _report(folder: Path, state: str, written: Written, message: str) -> RecoverReport:
    return RecoverReport(path=folder, state=state, message=message, **vars(written))


def _note(folder: Path, state: str, message: str) -> None:
    try:
        events = runstate.EventLog(folder)
        events.append("recovered", None, {"state": state, "message": message})
        events.close()
    except RecordingFailed as error:
        log.warning("%s", error)
