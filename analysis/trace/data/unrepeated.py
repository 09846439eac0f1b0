"""Notes on scatter between repeats that is not sensor noise.

A pump, a neighbouring machine or an intermittent fault acts with another phase in every repeat.
It is then part of the noise floor and leaves no repeatable residual. If it is a torque at one
frequency, `judge.unlocked` names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from analysis.trace.data.noise_floor import PERIODS, REPEATS, Floor
from analysis.trace.data.regression_data import RegressionData, Segment
from analysis.trace.settings import DATA
from rig.model.units import plain

Array = NDArray[np.float64]
# Determinant of sine and cosine over that of orthogonal ones, times 4, below which they are one.
SAME_COLUMN: Final = 1e-6


def unrepeated_notes(data: RegressionData) -> list[str]:
    """Return a note for each equation whose scatter between repeats exceeds stated sensor noise.

    The limit is `DATA.unrepeated_ratio`; of several groups the one with the largest ratio is noted.
    """
    return [_unrepeated_note(data, floor) for floor in unrepeated_floors(data).values()]


def unrepeated_floors(data: RegressionData) -> dict[str, Floor]:
    """Return the floor with the largest ratio to the stated noise, of each equation to be noted.

    Floors of steps whose rows are left out do not count.
    """
    used = {(s.group, s.equation) for s in data.segments}
    worst: dict[str, Floor] = {}
    for floor in data.floors:
        measured = floor.source in (REPEATS, PERIODS) and (floor.group, floor.equation) in used
        if measured and floor.noise > DATA.unrepeated_ratio * floor.stated:
            best = worst.get(floor.equation)
            if best is None or floor.noise / floor.stated > best.noise / best.stated:
                worst[floor.equation] = floor
    return worst


def _unrepeated_note(data: RegressionData, floor: Floor) -> str:
    segment = next(
        s for s in data.segments if (s.group, s.equation) == (floor.group, floor.equation)
    )
    frequency, share = _dominant_frequency(data, segment)
    at = ""
    if share > DATA.unrepeated_share:
        at = f", {plain(100 * share, 2)} % of it at {plain(frequency, 3)} Hz"
    return (
        f"{floor.equation}: what differs between repeats is {plain(floor.noise / floor.stated, 2)} "
        f"times what the stated sensor noise makes{at}: a sensor is noisier than stated, or "
        "something acts that does not follow the excitation, which the trace cannot see"
    )


def _dominant_frequency(data: RegressionData, segment: Segment) -> tuple[float, float]:
    """Return the frequency [Hz] at which most of the scatter between repeats lies, and its share.

    The share is of the energy, 0 with fewer than two repeats (periods hold no other frequency).
    """
    if segment.repeats < 2:
        return 0.0, 0.0
    return dominant_frequency([scatter(data, segment)])


def scatter(data: RegressionData, segment: Segment) -> tuple[Array, Array]:
    """Return the instants (m,) of a segment, and its repeats' residuals (n, m) less their mean."""
    rows = data.residual[: segment.repeats, segment.where]
    return data.source(segment)[1].time, rows - rows.mean(axis=0)


def dominant_frequency(parts: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Return the frequency [Hz] with most of the energy of series, and its share of the energy.

    `parts` are instants (m,) [s] with series (n, m) of any phase.
    """
    length = max(float(time[-1] - time[0]) for time, _ in parts)
    highest = 0.5 / float(np.median(np.diff(parts[0][0])))
    whole = sum(float(np.sum(series**2)) for _, series in parts)

    def share(frequency: Array) -> Array:
        return np.asarray(sum(_sine_energy(t, series, frequency) for t, series in parts) / whole)

    frequency = np.arange(2.0 / length, highest, 0.25 / length)
    coarse = float(frequency[np.argmax(share(frequency))])
    bounds = (coarse - 0.25 / length, coarse + 0.25 / length)
    best = minimize_scalar(lambda f: -share(np.array([f])).item(), bounds=bounds, method="bounded")
    return float(best.x), -float(best.fun)


def _sine_energy(time: Array, series: Array, frequency: Array) -> Array:
    """Return the energy (f,) that a sine at each frequency [Hz] fits in series (n, m), summed.

    Least squares with free amplitude and phase for each series (Lomb 1976).
    """
    series = series - series.mean(axis=1, keepdims=True)
    angle = 2 * np.pi * time[:, None] * frequency
    c, s = np.cos(angle), np.sin(angle)
    cc, ss, cs = (c * c).sum(axis=0), (s * s).sum(axis=0), (c * s).sum(axis=0)
    a, b = series @ c, series @ s
    fitted = (ss * a * a - 2 * cs * a * b + cc * b * b).sum(axis=0)
    both = cc * ss - cs * cs
    # Of instants at half the sampling rate or a multiple, sine and cosine are one column.
    one = both < SAME_COLUMN * (cc + ss) ** 2
    single = (a * a + b * b).sum(axis=0) / (cc + ss)
    return np.asarray(np.where(one, single, fitted / np.where(one, 1.0, both)))
