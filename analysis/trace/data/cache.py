"""Caches of rows, signals and parts of rows, which many models of the same records share."""

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


class Cache:
    """Values by key, about `most` bytes in total; the oldest value is dropped first."""

    def __init__(self, most: float) -> None:
        self.most, self.used = most, 0
        self._values: dict[Hashable, tuple[Any, int]] = {}

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the value of a key; `make` computes it if it is not stored."""
        entry = self._values.get(key)
        if entry is not None:
            return entry[0]
        value = make()
        size = _bytes(value)
        self._values[key] = value, size
        self.used += size
        while self.used > self.most and len(self._values) > 1:
            self.used -= self._values.pop(next(iter(self._values)))[1]
        return value

    def selected(self, keep: Callable[[Any], bool]) -> Cache:
        """Return a cache that begins with the values whose keys `keep` accepts."""
        out = Cache(self.most)
        out._values = {key: entry for key, entry in self._values.items() if keep(key)}
        out.used = sum(size for _, size in out._values.values())
        return out


class _RecordingSignals(Signals):
    """Signals that record which of their fields are read."""

    def __getattribute__(self, name: str) -> Any:
        if name in FIELDS:
            object.__getattribute__(self, "__dict__").setdefault(READ, set()).add(name)
        return object.__getattribute__(self, name)


class SignalCache:
    """Values computed from signals, by key; valid while the fields that they read are the same."""

    def __init__(self) -> None:
        self._values: dict[Hashable, list[tuple[list[tuple[str, Any]], Any]]] = {}

    def get(self, key: Hashable, signals: Signals, make: Callable[[Signals], Any]) -> Any:
        """Return `make(signals)`, computed again only if a field that `make` reads has changed."""
        stored = self._values.pop(key, [])  # put back as the newest
        self._values[key] = stored
        if len(self._values) > DATA.cached_parts:
            del self._values[next(iter(self._values))]
        for fields_read, value in stored:
            if all(getattr(signals, name) is x for name, x in fields_read):
                return value
        recording = _RecordingSignals(**vars(signals))
        value = make(recording)
        fields_read = [(name, getattr(signals, name)) for name in vars(recording).get(READ, ())]
        # The first entry belongs to the record's own signals, which most models use: it is kept.
        del stored[1 : len(stored) - DATA.cached_signal_sets + 2]
        stored.append((fields_read, value))
        return value


class RowCache:
    """The caches of one set of records: `rows`, `signals`, `parts` of rows, `fits` of models.

    `families` holds the families of rows that each term acts on.
    """

    def __init__(self) -> None:
        self.rows, self.signals = Cache(DATA.cached_row_bytes), Cache(DATA.cached_signal_bytes)
        self.parts, self.fits = SignalCache(), Cache(DATA.cached_row_bytes)
        self.families: dict[Term, frozenset[str]] = {}

    def without_family(self, family: str) -> RowCache:
        """Return a cache that begins with the rows and fits of all other families.

        They are valid for records whose rows of `family` alone are filtered otherwise.
        """
        out = RowCache()
        out.rows = self.rows.selected(lambda key: key[1] != family)
        out.fits = self.fits.selected(lambda key: key[0] != family)
        return out


def _bytes(value: Any) -> int:
    """Return the approximate size [bytes] of the arrays in a value."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    return sum(x.nbytes for x in vars(value).values() if isinstance(x, np.ndarray))
