"""Observers of a bench: they receive its blocks and records and cannot influence it.

An observer is called in the acquisition loop: it passes the data on (to another process) and
returns at once. An observer that raises is removed, and the run continues.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from drivers.base import SampleBlock
from rig.runs.recorder import RecordMeta

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
