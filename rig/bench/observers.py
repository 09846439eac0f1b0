"""A record in progress, and the observers of a bench, who receive its blocks and records.

An observer is called in the acquisition loop: it passes the data on (to another process) and
returns at once. It cannot influence the bench: one that raises is removed, and the run continues.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from drivers.base import SampleBlock
from rig.model.trips import RecordingFailed
from rig.runs.recorder import Attribute, Recorder, RecordMeta

log = logging.getLogger(__name__)


class Observer(Protocol):
    """Receives every block and every record of a bench."""

    def block(self, block: SampleBlock) -> None:
        """Receive a block that was checked and journalled."""

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        """A record begins at tick `start`, past or future; `ticks` is its length if known."""

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        """A record of `ticks` samples from `start` has ended in `state`."""


class Observers:
    """The observers of one bench, as one observer that never raises."""

    def __init__(self) -> None:
        self._all: list[Observer] = []

    def add(self, observer: Observer) -> None:
        """Add an observer."""
        self._all.append(observer)

    def _notify(self, call: Callable[[Observer], None]) -> None:
        for observer in tuple(self._all):
            try:
                call(observer)
            except Exception:
                self._all.remove(observer)
                log.exception(
                    "%s failed and is removed for the rest of this run", type(observer).__name__
                )

    def block(self, block: SampleBlock) -> None:
        """Pass a block on."""
        if self._all:
            self._notify(lambda observer: observer.block(block))

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        """Announce the begin of a record."""
        self._notify(lambda observer: observer.record_begins(meta, start, ticks))

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        """Announce the end of a record."""
        self._notify(lambda observer: observer.record_ends(meta, start, ticks, state))


class RecordedBench(Protocol):
    """The part of a bench that a record uses."""

    @property
    def tick(self) -> int:
        """Tick of the newest sample."""

    @property
    def recorder(self) -> Recorder | None:
        """The run's recorder, None if nothing is recorded."""

    @property
    def observers(self) -> Observers:
        """The observers to notify of a record's begin and end."""

    def zero_outputs(self) -> bool:
        """Set all outputs to zero; return whether the device confirmed it."""


class RecordHandle:
    """A record in progress: `with` (or `open`) begins it; an exception leaves it unfinished."""

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
        """Length of the record [samples]: as fixed, or up to the newest sample."""
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
        """Discard the record: its samples stay in the run and its name can be used again."""
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
        self._bench.zero_outputs()  # before anything is written, whatever the exception
        try:
            self.close("partial")
        except RecordingFailed as problem:
            log.error("%s", problem)
