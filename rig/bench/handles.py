"""A record while it is taken: a tick range of the stream with its attributes."""

from __future__ import annotations

import logging
from types import TracebackType
from typing import Protocol, Self

from rig.bench.observers import Observers
from rig.model.trips import RecordingFailed
from rig.runs.recorder import Attribute, Recorder, RecordMeta

log = logging.getLogger(__name__)


class RecordedBench(Protocol):
    """What a record needs of the bench that takes it."""

    @property
    def tick(self) -> int:
        """Tick of the newest sample."""

    @property
    def recorder(self) -> Recorder | None:
        """The run's recorder, None where nothing is kept."""

    @property
    def observers(self) -> Observers:
        """Who is told when a record begins and ends."""

    def zero_outputs(self) -> bool:
        """Put all outputs to zero; whether the device confirmed it."""


class RecordHandle:
    """Opened by `with` (or `open`), closed at its end; left by an exception it is unfinished."""

    def __init__(
        self, bench: RecordedBench, meta: RecordMeta, start_tick: int, ticks: int | None
    ) -> None:
        self.meta = meta
        self.start_tick = start_tick
        self._bench = bench
        self._ticks = ticks
        self._more: dict[str, Attribute] = {}
        self._number: int | None = None
        self._closed = False

    @property
    def ticks(self) -> int:
        """Samples of the record: as fixed, or up to the newest one."""
        return self._bench.tick - self.start_tick if self._ticks is None else self._ticks

    def note(self, **attributes: Attribute) -> None:
        """Add attributes: text, numbers."""
        self._more.update(attributes)

    def open(self) -> Self:
        """Begin the record."""
        recorder = self._bench.recorder
        if recorder is not None:
            self._number = recorder.begin_record(self.meta, self.start_tick)
        self._bench.observers.record_begins(self.meta, self.start_tick, self._ticks)
        return self

    def close(self, state: str = "complete") -> None:
        """End the record: complete, partial or discarded."""
        recorder = self._bench.recorder
        if recorder is not None and self._number is not None and not self._closed:
            recorder.end_record(self._number, self.meta, self.ticks, state, self._more)
        if not self._closed:
            self._bench.observers.record_ends(self.meta, self.start_tick, self.ticks, state)
        self._closed = True

    def discard(self, reason: str) -> None:
        """End it as no record; its samples stay in the run, its name becomes free."""
        self.note(discarded=reason)
        self.close("discarded")

    __enter__ = open

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
            return
        self._bench.zero_outputs()  # before anything is written, whoever raised
        try:
            self.close("partial")
        except RecordingFailed as problem:
            log.error("%s", problem)
