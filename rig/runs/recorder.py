"""The recorder of one run: opens the folder, journals every block, finishes into records.h5."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.base import DeviceInfo, SampleBlock
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed
from rig.runs import store
from rig.runs.journal import Journal
from rig.runs.runstate import (
    ABORTED,
    BETWEEN,
    JOURNAL,
    RUNNING,
    STATES,
    STREAM,
    EventLog,
    StreamClock,
    release_ownership,
    utc_now,
    write_state,
)
from rig.runs.salvage.rebuild import move_aside
from rig.runs.sections import Written

log = logging.getLogger(__name__)

_STEP = re.compile(r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$")
Attribute = str | float | int


@dataclass(frozen=True)
class RecordMeta:
    """Description of a record: step, repeat, locked joints, excitation.

    `locked` holds 1-based joints; `period` [samples] and `lines` describe the excitation;
    `name` defaults to ``{step}_r{repeat}``. Raises ValueError for an invalid name.
    """

    step: str
    repeat: int = 1
    locked: tuple[int, ...] = ()
    period: int = 0
    lines: tuple[int, ...] = ()
    name: str = ""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", f"{self.step}_r{self.repeat}")
        for text in (self.step, self.name):
            if not _STEP.match(text) or text == BETWEEN:
                raise ValueError(f"{text!r} cannot name a record; use letters, digits, '_', '-'")

    def as_dict(self, further: Mapping[str, Attribute] | None = None) -> dict[str, Any]:
        """Return the description as plain data, with further attributes."""
        return {
            "name": self.name,
            "step": self.step,
            "repeat": self.repeat,
            "locked": list(self.locked),
            "period": self.period,
            "lines": list(self.lines),
            "attributes": {**self.attributes, **(further or {})},
        }


class Recorder:
    """Writes one run folder; nothing exists on the disk before `open`.

    Raises InputError at once if the folder is occupied, RecordingFailed when the disk fails.
    """

    def __init__(
        self,
        folder: str | Path,
        rig: Rig,
        *,
        protocol: Mapping[str, Any] | None = None,
        seed: int | None = None,
        operator: str | None = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.rig = rig
        self._about = {
            "protocol": protocol,
            "seed": seed,
            "operator": operator,
            "provenance": provenance,
        }
        self._journal: Journal | None = None
        self._events: EventLog | None = None
        self._names: set[str] = set()
        self._unfinished: tuple[int, RecordMeta, int] | None = None  # the last record that ended
        self._stream = 0
        self._clock: StreamClock | None = None  # of the current stream, from its first block on
        self.elapsed = 0.0  # [s] since the run began, of the newest sample, across restarts
        self._began = 0.0  # [s] by the host's clock, at the arrival of the first block
        store.refuse_occupied(self.folder)

    @property
    def is_open(self) -> bool:
        """Whether the journal is open, so that blocks can be recorded."""
        return self._journal is not None

    def open(self, info: DeviceInfo) -> None:
        """Create the folder and its journal; the state of the run is then `running`."""
        about: Any = self._about
        store.create_run(
            self.folder, self.rig, device=info.identity, virtual_time=info.virtual_time, **about
        )
        try:
            self._open_files(info)
        except RecordingFailed:
            with suppress(OSError):
                write_state(self.folder, ABORTED)
                release_ownership(self.folder)
            raise

    def _open_files(self, info: DeviceInfo) -> None:
        self._events = EventLog(self.folder)
        self.event("start", device=info.identity, virtual_time=info.virtual_time)
        self._journal = Journal.create(
            self.folder / JOURNAL, self.rig.recorded, len(self.rig.channels), info.sample_rate
        )

    def _open_journal(self) -> Journal:
        if self._journal is None:
            raise RecordingFailed(f"{self.folder}: the run is not open for recording")
        return self._journal

    def begin_stream(self) -> None:
        """Begin a stream: the device's ticks restart with the next block.

        A record that the end of the previous stream left unfinished is discarded; its name is free.
        """
        if self._unfinished is not None:
            number, meta, ticks = self._unfinished
            why: dict[str, Attribute] = {"discarded": "the stream ended in it"}
            self.end_record(number, meta, ticks, "discarded", why)
        self._stream += 1
        self._clock = None

    def append(self, block: SampleBlock, late: float | None) -> None:
        """Write one block, which arrived `late` [s] (None in virtual time)."""
        journal = self._journal or self._open_journal()
        journal.append(self._stream, block, late)
        if self._clock is None:
            self._begin_clock(block, virtual=late is None)
        else:
            self.elapsed = self._clock.at(block.tick + len(block.data), self.rig.sample_rate)

    def _begin_clock(self, block: SampleBlock, *, virtual: bool) -> None:
        """Set the time since the run's begin of a stream's first tick."""
        arrived = time.monotonic()
        length = len(block.data) / self.rig.sample_rate
        first = not self._began
        self._began = self._began or arrived
        # In virtual time the clocks are unrelated: streams follow without a gap.
        began = 0.0 if first else self.elapsed if virtual else arrived - self._began
        self.elapsed = began
        self._clock = StreamClock(block.tick, began, utc_now())
        self.event(STREAM, block.tick, stream=self._stream)
        self.elapsed = began + length

    def time_of(self, tick: int) -> float | None:
        """Return the time [s] since the run began of a device tick; None before a first block."""
        return None if self._clock is None else self._clock.at(tick, self.rig.sample_rate)

    def event(self, event: str, tick: int | None = None, **fields: Any) -> None:
        """Write one event; it is on disk when this returns."""
        if self._events is None:
            raise RecordingFailed(f"{self.folder}: the run is not open for recording")
        timed = None if tick is None else self.time_of(tick)
        seconds = self.elapsed if timed is None else timed
        self._events.append(event, tick, {"t": round(seconds, 6), **fields})

    def begin_record(self, meta: RecordMeta, start: int) -> int:
        """Open a record at a tick; raises ValueError if its name was used before."""
        if meta.name in self._names:
            raise ValueError(f"this run already has a record {meta.name!r}; expected another name")
        number = self._open_journal().begin_mark(self._stream, start, meta.as_dict())
        self._names.add(meta.name)
        self.event("record begins", start, record=meta.name)
        return number

    def end_record(
        self, number: int, meta: RecordMeta, ticks: int, state: str, more: Mapping[str, Attribute]
    ) -> None:
        """Close a record after `ticks` samples: `state` is complete, partial or discarded."""
        self._open_journal().end_mark(number, ticks, state, meta.as_dict(more))
        self._unfinished = (number, meta, ticks) if state == "partial" else None
        if state == "discarded":
            self._names.discard(meta.name)
        self.event(f"record {state}", record=meta.name, ticks=ticks)

    def finish(self, state: str, message: str = "") -> None:
        """End the run: write and verify records.h5, set the state, remove the journal.

        If the archive cannot be written the state is `aborted`, the journal stays, and
        RecordingFailed says what to do. Further calls do nothing.
        """
        if state not in STATES or state == RUNNING:
            raise ValueError(f"{state!r} is not a final state")
        journal, self._journal = self._journal, None
        if journal is None:
            return
        try:
            with suppress(RecordingFailed):  # a full disk: recover then says interrupted
                journal.set_meta("outcome", state)
            self._finalise(journal, state, message)
        finally:
            if self._events is not None:
                self._events.close()
            with suppress(OSError):
                release_ownership(self.folder)

    def _finalise(self, journal: Journal, state: str, message: str) -> None:
        def note(written: Written) -> None:
            self.event("end", state=state, message=message, records=written.records)

        try:
            journal.require_folder()
            finalise(journal, self.folder, self.rig.name, state, note)
        except RecordingFailed as error:
            journal.close()
            with suppress(RecordingFailed):
                self.event("end", state=ABORTED, message=str(error))
            try:
                write_state(self.folder, ABORTED)
            except OSError as problem:
                log.error("%s: state cannot be written: %s", self.folder, problem)
            raise


def finalise(
    journal: Journal,
    folder: Path,
    rig_name: str,
    state: str,
    note: Callable[[Written], None] | None = None,
) -> Written:
    """Convert a journal to records.h5, call `note`, set the state, remove the journal.

    `note` writes why the run ended, before the state is set, so that a kill in between leaves no
    state without a reason. A journal with damaged blocks is kept as `journal.damaged.sqlite`.
    Raises RecordingFailed; the journal is then unchanged.
    """
    from rig.runs.archive import write_from_journal  # noqa: PLC0415 - h5py loads slowly

    written = write_from_journal(journal, folder, rig_name)
    if note is not None:
        note(written)
    try:
        write_state(folder, state)
    except OSError as error:
        raise RecordingFailed(f"{folder}: state cannot be written: {error.strerror}") from error
    if written.damaged_blocks:
        journal.close()
        move_aside(journal.path)
    else:
        journal.delete()
    return written
