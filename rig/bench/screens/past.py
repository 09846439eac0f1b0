"""The last minute of a run, kept by the run for screens that attach late.

Of each snapshot, one bucket is kept: the smallest and the largest sample of every channel. The
answer to the command "past" is a JSON header and a float64 array (buckets, 1 + 2 channels): device
time [s], smallest samples, largest samples [SI].
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KEPT: Final = 1200  # buckets: one minute of wall time at twenty snapshots a second


@dataclass(frozen=True)
class PlanLine:
    """One step of the plan for a screen: name, description, expected time [s]."""

    name: str
    title: str
    seconds: float


@dataclass(frozen=True)
class PastMinute:
    """The last minute of a run: ends (n,) of the buckets [s of device time], their low and high."""

    names: tuple[str, ...]
    time: Array
    low: Array
    high: Array
    plan: tuple[PlanLine, ...] = ()


class PastKeeper:
    """Keeps the newest buckets of a run."""

    def __init__(self, names: Sequence[str]) -> None:
        self.plan: tuple[PlanLine, ...] = ()
        self._names = tuple(names)
        self._rows: deque[Array] = deque(maxlen=KEPT)

    def add(self, device_time: float, samples: Array) -> None:
        """Add the samples (n, channels) of a snapshot as one bucket; n = 0 adds none."""
        if len(samples):
            low, high = np.minimum.reduce(samples, axis=0), np.maximum.reduce(samples, axis=0)
            parts = ([device_time], low, high)
            self._rows.append(np.concatenate(parts))

    def answer(self) -> tuple[dict[str, Any], bytes]:
        """Return the header and the bytes of the array."""
        width = 1 + 2 * len(self._names)
        table = np.array(self._rows) if self._rows else np.empty((0, width))
        header = {"names": self._names, "plan": [asdict(line) for line in self.plan]}
        return header, np.ascontiguousarray(table, dtype="<f8").tobytes()


def past_from(header: Mapping[str, Any], raw: bytes) -> PastMinute:
    """Read an answer; raises ValueError for anything else."""
    try:
        names = tuple(map(str, header["names"]))
        table = np.frombuffer(raw, dtype="<f8").reshape(-1, 1 + 2 * len(names))
        plan = tuple(PlanLine(**line) for line in header["plan"])
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a valid answer to the command past: {error}") from error
    cut = 1 + len(names)
    return PastMinute(names, table[:, 0], table[:, 1:cut], table[:, cut:], plan)
