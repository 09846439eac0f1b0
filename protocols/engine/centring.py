"""Keeping an open-loop piston centred: pure functions from samples to the next bias.

A valve's gains differ by chamber and direction, so that an asymmetric cylinder drifts under a
symmetric command, by millimetres a second. About a working point the piston is an integrator,

    ds/dt = k (v - v0)          k [m/(s V)], v0 [V] the command that neither extends nor retracts,

with k and v0 depending on the waveform. Both are measured from the motion itself, period by
period; a nominal model is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocols.engine.settings import ENGINE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Recent motion of a piston.

    `drift` [m/s] is its mean velocity, `mean` [m] the mean of the last period, `ends` [m] that mean
    extrapolated to the last sample.
    """

    drift: float
    mean: float
    ends: float


@dataclass(frozen=True)
class Follow:
    """Response of a piston to its command: gain k [m/(s V)], null v0 [V], drift d [m/s]."""

    gain: float
    null: float
    drift: float


_UNKNOWN = Follow(float("nan"), float("nan"), float("nan"))


def follow(command: Array, piston: Array, rate: float) -> Follow:
    """Fit s = c + d t + k integral(v - mean v) to a stretch of samples; v0 = mean v - d / k.

    Needs no derivative of a measured signal, no whole period and no particular law, because the
    output is known. Short gaps (NaN) are bridged. Returns NaN where the command hardly varies or
    too few samples arrived.
    """
    arrived = np.isfinite(command) & np.isfinite(piston)
    if np.count_nonzero(arrived) < 10:
        return _UNKNOWN
    time = np.arange(len(command)) / rate
    bridged = np.interp(time, time[arrived], command[arrived])
    middle = float(np.mean(bridged))
    integral = np.cumsum(bridged - middle) / rate
    if np.ptp(integral) < 1e-9:
        return _UNKNOWN
    basis = np.column_stack((np.ones_like(time), time, integral))[arrived]
    _, drift, gain = np.linalg.lstsq(basis, piston[arrived], rcond=None)[0]
    null = middle - float(drift / gain) if gain else float("nan")
    return Follow(float(gain), null, float(drift))


def motion(piston: Array, period: int, rate: float) -> Motion:
    """Return the drift between the last two periods of `piston`, shape (n >= 2 period,).

    Samples one period apart have the same phase: their difference, averaged over the last
    quarter of a period, is the drift whatever the waveform.
    """
    last, before = piston[-period:], piston[-2 * period : -period]
    tail = max(1, round(ENGINE.drift_tail * period))
    drift = float(np.nanmean(last[-tail:] - before[-tail:])) * rate / period
    return moved_by(last, drift, rate)


def moved_by(last: Array, drift: float, rate: float) -> Motion:
    """Return the motion of a piston whose last period and drift [m/s] are known."""
    mean = float(np.nanmean(last))
    return Motion(drift, mean, mean + drift * 0.5 * len(last) / rate)


def recentring(moved: Motion, centre: float, seconds: float, cap: float) -> float:
    """Return the target drift [m/s]: half of the offset in `seconds`, at most `cap` [m]."""
    return -float(np.clip(ENGINE.recentre_share * (moved.ends - centre), -cap, cap)) / seconds


def free_path(wave: Array, period: int, gain: float, rate: float) -> Array:
    """Return the motion (period,) [m] about its mean of a piston with `gain` [m/(s V)]."""
    command = np.resize(wave, period)
    path = np.cumsum(command - command.mean()) * gain / rate
    return np.asarray(path - path.mean())


def under_loop(piston: Array, pull: float, rate: float) -> Array:
    """Return a period (n,) of the piston, about zero, while a position loop centres it.

    `pull` [1/s] is the loop's gain times the piston's speed per volt; a line at w is multiplied by
    j w / (j w + pull). Slow lines shrink and phases change, so that peaks may grow.
    """
    w = 2 * np.pi * np.fft.rfftfreq(len(piston), 1.0 / rate)
    lines = np.fft.rfft(piston) * 1j * w / (1j * w + pull)
    return np.fft.irfft(lines, len(piston))


def trim(bias: float, drift: float, target: float, gain: float) -> float:
    """Return the bias [V] that changes the drift d [m/s] to the target w: v + (w - d) / k."""
    return bias + (target - drift) / gain


@dataclass(frozen=True)
class BiasForecast:
    """Lowest and highest piston [m] expected until the end.

    `shift` [m] is the change of the piston since one period ago, `slope` [m/s] its rate.
    """

    low: float
    high: float
    slope: float
    shift: float


def forecast(
    reference: Array, samples: Array, horizon: int, rate: float, shortest: int
) -> BiasForecast:
    """Predict a piston's motion, assuming that it repeats one period plus a drift.

    `reference` (period,) is that period; `samples` (m,) those since, from phase 0; `horizon` the
    number of samples to come. samples - reference is a straight line where the drift changed once,
    at the trim. From `shortest` samples on the line is extrapolated, by its own length at most,
    because the slope of a short line is inaccurate.
    """
    period, m = len(reference), len(samples)
    stride = max(1, min(period, m) // 500)
    indices = np.arange(m - 1, -1, -stride)[::-1]
    deviation = samples[indices] - reference[indices % period]
    arrived = np.isfinite(deviation)
    shift = float(np.mean(deviation[arrived][-20:])) if arrived.any() else 0.0
    slope = 0.0
    if m >= shortest and np.count_nonzero(arrived) > 2:
        time = indices[arrived] - np.mean(indices[arrived])
        slope = rate * float(time @ deviation[arrived] / (time @ time))
    reach = max(1, min(horizon, m))
    future = np.arange(0, reach, max(1, reach // 1000))
    path = reference[(m + future) % period] + shift + slope * future / rate
    return BiasForecast(float(np.fmin.reduce(path)), float(np.fmax.reduce(path)), slope, shift)


def leaves(expected: BiasForecast, low: float, high: float) -> bool:
    """Return whether the forecast exceeds a piston limit [m], less a margin."""
    return expected.low < low + ENGINE.limit_margin or expected.high > high - ENGINE.limit_margin
