"""Finalise a run whose process died, wherever it died."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rig.model.parse import InputError
from rig.model.trips import RecordingFailed
from rig.runs import runstate, store
from rig.runs.journal import Journal
from rig.runs.recorder import finalise
from rig.runs.sections import Written

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecoverReport:
    """What `recover` found and did; `records` counts complete and partial ones."""

    path: Path
    state: str
    records: int
    partial: int
    samples: int
    lost_samples: int
    damaged_blocks: int
    message: str


def recover(path: str | Path, *, force: bool = False) -> RecoverReport:
    """Finalise an interrupted run; doing it twice is harmless.

    The state becomes the one the run was about to end in, or `interrupted`. `force` recovers a
    run of another computer, where this one cannot ask whether its process lives. Raises
    InputError (no run, still running) and RecordingFailed (the disk).
    """
    folder = Path(path)
    header = store.read_header(folder)
    _refuse_if_alive(folder, force)
    try:
        if not (folder / runstate.JOURNAL).exists():
            return _without_journal(folder)
        stood = runstate.read_state(folder)
        runstate.take_ownership(folder)
        try:
            return _from_journal(folder, header.rig.name, stood)
        finally:
            runstate.give_up_ownership(folder)
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
    if owner.host != runstate.here() and not force:
        raise InputError(
            f"{folder}: was being written on computer {owner.host!r}; recover it there, or with "
            "force if that run is surely over"
        )


def _from_journal(folder: Path, rig_name: str, stood: str) -> RecoverReport:
    for stray in folder.glob("*.tmp"):
        stray.unlink(missing_ok=True)
    journal = Journal.open(folder / runstate.JOURNAL)
    try:
        state = str(journal.meta("outcome") or stood)
        written = finalise(journal, folder, rig_name, state)
    finally:
        journal.close()
    message = (
        f"{written.records} record(s), {written.partial} of them unfinished, "
        f"{written.samples} samples, {written.lost_samples} lost"
    )
    if written.damaged_blocks:
        message += f"; {written.damaged_blocks} damaged block(s), see journal.damaged.sqlite"
    _note(folder, state, message)
    return _report(folder, state, written, message)


def _without_journal(folder: Path) -> RecoverReport:
    state = runstate.read_state(folder)
    archive = folder / store.ARCHIVE
    if not archive.exists():
        runstate.write_state(folder, state)
        message = "nothing had been recorded"
        _note(folder, state, message)
        return _report(folder, state, Written(0, 0, 0, 0, 0), message)
    from rig.runs.archive_reader import read_records  # noqa: PLC0415 - h5py loads slowly

    records = read_records(archive)
    runstate.write_state(folder, state)
    with suppress(OSError):
        runstate.give_up_ownership(folder)
    written = Written(
        len(records),
        sum(not r.attributes["complete"] for r in records),
        sum(r.samples for r in records),
        sum(int(r.attributes.get("lost_samples", 0)) for r in records),
        0,
    )
    return _report(folder, state, written, "was finalised already")


def _report(folder: Path, state: str, written: Written, message: str) -> RecoverReport:
    return RecoverReport(
        folder,
        state,
        written.records,
        written.partial,
        written.samples,
        written.lost_samples,
        written.damaged_blocks,
        message,
    )


def _note(folder: Path, state: str, message: str) -> None:
    try:
        events = runstate.EventLog(folder)
        events.append("recovered", None, {"state": state, "message": message})
        events.close()
    except RecordingFailed as error:
        log.warning("%s", error)
