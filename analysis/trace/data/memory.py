"""What has been made of records and is needed again: rows that many models share, signals."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import fields
from typing import Any

import numpy as np

from analysis.signals.conditioning import Signals
from analysis.terms.base import Term
from analysis.trace.settings import DATA

FIELDS = frozenset(f.name for f in fields(Signals))
READ = "read"


class Memory:
    """Values by key, of at most about `most` bytes: the oldest goes first."""

    def __init__(self, most: float) -> None:
        self.most, self.used = most, 0
        self._kept: dict[Hashable, tuple[Any, int]] = {}

    def of(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return what belongs to a key, made where it is not remembered."""
        found = self._kept.get(key)
        if found is not None:
            return found[0]
        value = make()
        size = _bytes(value)
        self._kept[key] = value, size
        self.used += size
        while self.used > self.most and len(self._kept) > 1:
            self.used -= self._kept.pop(next(iter(self._kept)))[1]
        return value


class _Watched(Signals):
    """Signals that note which of their fields are read."""

    def __getattribute__(self, name: str) -> Any:
        if name in FIELDS:
            object.__getattribute__(self, "__dict__").setdefault(READ, set()).add(name)
        return object.__getattribute__(self, name)


class Readings:
    """What follows from signals, by key: made again only where a signal that it reads differs."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, list[tuple[list[tuple[str, Any]], Any]]] = {}

    def of(self, key: Hashable, signals: Signals, make: Callable[[Signals], Any]) -> Any:
        """Return what `make` makes of the signals."""
        known = self._kept.setdefault(key, [])
        for read, value in known:
            if all(getattr(signals, name) is x for name, x in read):
                return value
        watched = _Watched(**vars(signals))
        value = make(watched)
        read = [(name, getattr(signals, name)) for name in vars(watched).get(READ, ())]
        # The first is that of the records themselves.
        del known[1 : len(known) - DATA.remembered_readings + 2]
        known.append((read, value))
        return value


class RowMemory:
    """What is remembered of some records: parts of their rows, and the signals behind them.

    And which families of rows a term is in.
    """

    def __init__(self) -> None:
        self.rows, self.signals = Memory(DATA.remembered_rows), Memory(DATA.remembered_signals)
        self.parts = Readings()
        self.families: dict[Term, frozenset[str]] = {}


def _bytes(value: Any) -> int:
    """Return about how many bytes the arrays of a value take."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    return sum(x.nbytes for x in vars(value).values() if isinstance(x, np.ndarray))
