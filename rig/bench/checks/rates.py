"""Rates of change: speed of a piston, rate of a pressure.

Rates are differences over the shortest window in which the sensor's own noise stays below a
tenth of the limit: |x[k] - x[k-w]| fs / w, 6 sqrt(2) sigma fs / w <= 0.1 limit. A block is
checked together with the tail of the previous one, so that rates across blocks are checked too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.bench.checks.bands import first_of
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.trips import Violation

Array = NDArray[np.float64]


def rate_window(noise: float, limit: float, sample_rate: float) -> int:
    """Return the window [samples] of a rate: the shortest that keeps its noise below limit/10."""
    return max(1, math.ceil(6.0 * math.sqrt(2.0) * noise * sample_rate / (0.1 * limit)))


@dataclass(frozen=True)
class Rate:
    """A bound on |x[k] - x[k-window]|, (recorded,), infinite without a limit; `near` it warns."""

    limit: str
    window: int
    bounds: Array
    near: Array

    def find(
        self, rig: Rig, joined: Array, first: int, new: int
    ) -> tuple[Violation | None, list[Violation]]:
        """Return the first violation of the limit, and one per channel that is near it.

        `joined` (n, recorded) begins at tick `first`; only its last `new` samples are checked. It
        may contain infinite samples: the caller suppresses numpy's warning of their difference.
        """
        values = joined[-(new + self.window) :]
        steps = values[self.window :] - values[: -self.window]
        size = np.abs(steps)
        near = size > self.near
        if not np.count_nonzero(near):
            return None, []
        start = first + len(joined) - len(values) + self.window
        share = rig.alarms.warning_share
        exceeded = size > self.bounds
        trip = None
        if exceeded.any():
            trip = self._violation(rig, steps, start, *first_of(exceeded), 1.0)
        warnings = [
            self._violation(rig, steps, start, int(np.argmax(near[:, column])), column, share)
            for column in np.flatnonzero(near.any(axis=0)).tolist()
        ]
        return trip, warnings

    def _violation(
        self, rig: Rig, steps: Array, start: int, row: int, column: int, share: float
    ) -> Violation:
        name = rig.recorded[column]
        per_second = rig.sample_rate / self.window
        bound = share * float(self.bounds[column]) * per_second
        value = float(steps[row, column]) * per_second
        unit = f"{ch.unit_of(name)}/s"
        joint = ch.kind_of(name)[1]
        return Violation(self.limit, value, (-bound, bound), unit, joint, name, start + row)


def rates(rig: Rig) -> tuple[Rate, ...]:
    """Return the bounds on rates of a rig, one per kind and window."""
    limits_by_window: dict[tuple[str, int], list[tuple[int, float]]] = {}
    for column, name in enumerate(rig.channels):
        kind, joint = ch.kind_of(name)
        if joint is None or kind not in (ch.PISTON, ch.CAP, ch.ROD):
            continue
        limits = rig.joints[joint - 1].limits
        limit = limits.speed if kind == ch.PISTON else limits.pressure_rate
        window = rate_window(rig.sensors.of(kind).noise, limit, rig.sample_rate)
        what = "piston speed" if kind == ch.PISTON else "pressure rate"
        limits_by_window.setdefault((what, window), []).append((column, limit))
    bounded_rates = []
    for (name, window), entries in limits_by_window.items():
        bounds = np.full(len(rig.recorded), math.inf)
        for column, limit in entries:
            bounds[column] = limit * (window / rig.sample_rate)
        bounded_rates.append(Rate(name, window, bounds, rig.alarms.warning_share * bounds))
    return tuple(bounded_rates)
