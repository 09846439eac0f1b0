"""Who wants to see what a bench measures while it measures it, without a say in it.

An observer is called in the acquisition loop: it hands the data on (to another process) and
returns at once. One that raises is dismissed, and the run goes on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from drivers.base import SampleBlock
from rig.runs.recorder import RecordMeta

log = logging.getLogger(__name__)


class Observer(Protocol):
    """Is told every block and every record of a bench."""

    def block(self, block: SampleBlock) -> None:
        """Take a block that was checked and journalled."""

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        """Hear that a record begins at a tick, past or to come; `ticks` long if that is known."""

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        """Hear which ticks a record holds, now that it is `complete`, `partial`, `discarded`."""


class Observers:
    """The observers of one bench; itself an observer that never raises."""

    def __init__(self) -> None:
        self._all: list[Observer] = []

    def add(self, observer: Observer) -> None:
        """Let an observer see from now on."""
        self._all.append(observer)

    def _notify(self, call: Callable[[Observer], None]) -> None:
        for observer in tuple(self._all):
            try:
                call(observer)
            except Exception:
                self._all.remove(observer)
                log.exception("%s failed and sees no more of this run", type(observer).__name__)

    def block(self, block: SampleBlock) -> None:
        """Show a block."""
        if self._all:
            self._notify(lambda observer: observer.block(block))

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        """Handle the beginning of a record."""
        self._notify(lambda observer: observer.record_begins(meta, start, ticks))

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        """Handle the end of a record."""
        self._notify(lambda observer: observer.record_ends(meta, start, ticks, state))
