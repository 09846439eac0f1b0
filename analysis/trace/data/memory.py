"""What has been made of records and is needed again: rows that many models share, signals."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from analysis.terms.base import Term
from analysis.trace.settings import DATA


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


class RowMemory:
    """What is remembered of some records: parts of their rows, and the signals behind them.

    And which families of rows a term is in.
    """

    def __init__(self) -> None:
        self.rows, self.signals = Memory(DATA.remembered_rows), Memory(DATA.remembered_signals)
        self.families: dict[Term, frozenset[str]] = {}


def _bytes(value: Any) -> int:
    """Return about how many bytes the arrays of a value take."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if isinstance(value, Mapping):
        return sum(map(_bytes, value.values()))
    if is_dataclass(value):
        return sum(_bytes(getattr(value, f.name)) for f in fields(value))
    return 0
