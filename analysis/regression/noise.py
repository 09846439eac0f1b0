"""Attenuation of least squares by sensor noise in the regressor, predicted from stated noise.

Noise in the columns biases least squares (attenuation). The rig's stated noise is added to a
record a second time; the difference D of its rows [X y] is, to first order, distributed like the
noise that is in the rows already. With N = D'D and A = X'X,
 bias = - A^-1 (N_xx beta - n_xy),
and the diagonal of A^-1 N_xx is the share of a column's own information that is noise: a parameter
determined mostly by noise (the inertia of a joint that hardly moves in its lock) is not identified.
Source: Fuller, Measurement Error Models, section 2.2.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Array, Rows, in_common, record_rows
from analysis.regression.settings import REGRESSION
from analysis.signals.filters import Smoother
from analysis.terms.base import Used, family_of
from rig.model import channels as ch
from rig.model.numerics.spectra import power_spectrum
from rig.model.parts import AnySensor, converter_step
from rig.model.records import Record, bridged
from rig.model.rig import Rig

_BANDS = 8  # of the upper half of a spectrum
_LEAST_SAMPLES = 512  # for 16 frequencies in each band
_HARMONICS = 50  # of a rounding error as a function of the signal: 99 % of its variance


def sensor_variance(sensor: AnySensor) -> float:
    """Return the variance of one sample [SI^2]: stated noise and the converter's rounding."""
    return float(sensor.noise**2 + converter_step(sensor) ** 2 / 12.0)


def repeated_rounding(sensor: AnySensor) -> float:
    """Return the variance [SI^2] of the rounding error that is the same in every repeat.

    It is that of `mean_rounding` at values evenly over a step; without noise it is q^2 / 12.
    """
    amplitudes = _rounding_amplitudes(sensor)
    return float(0.5 * amplitudes @ amplitudes)


def mean_rounding(sensor: AnySensor, x: Array) -> Array:
    """Return the mean over repeats of the rounding error [SI] at values x (n,) before a converter.

    With noise of standard deviation s before a converter of step q it is the sum over k >= 1 of
    (-1)^k (q / (pi k)) exp(-2 (pi k s / q)^2) sin(2 pi k x / q), for steps at (j + 1/2) q (Widrow
    and Kollar, Quantization Noise, 2008, ch. 4).
    """
    amplitudes = _rounding_amplitudes(sensor)
    phase, total = 2.0 * np.pi * x / converter_step(sensor), np.zeros_like(x)
    for k, amplitude in enumerate(amplitudes, start=1):
        if amplitude > 1e-3 * amplitudes[0]:
            total += (-1) ** k * amplitude * np.sin(k * phase)
    return total


def _rounding_amplitudes(sensor: AnySensor) -> Array:
    step, k = converter_step(sensor), np.arange(1, _HARMONICS + 1)
    scale = np.exp(-2.0 * (np.pi * k * sensor.noise / step) ** 2)
    return np.asarray(step / (np.pi * k) * scale)


def with_added_noise(
    rig: Rig, record: Record, rng: np.random.Generator, as_measured: bool = False
) -> Record:
    """Return the record with noise of the rig file's sensors added, rounding included.

    Where a sensor's samples hold more than `REGRESSION.stated_ratio` times that as white noise
    (`white_variance`), noise of that size is added, and `as_measured` where they hold less.
    Inputs may hold more: what a loop puts out at random is no error of measurement.
    """

    def noise(name: str, sensor: AnySensor, x: Array) -> Array:
        variance = sensor_variance(sensor)
        is_input = ch.kind_of(name)[0] in (ch.SPOOL, ch.DRIVE)
        if as_measured or not is_input:
            white = white_variance(bridged(x))
            larger = white > REGRESSION.stated_ratio**2 * variance and not is_input
            if larger or (as_measured and white < variance):
                variance = white
        return np.asarray(np.sqrt(variance) * rng.standard_normal(len(x)))

    return _with_errors(rig, record, noise)


def white_variance(x: Array) -> float:
    """Return the variance of white noise that samples x (n,) hold at most, by their upper spectrum.

    It is half the sample rate times the smallest of the mean power densities of `_BANDS` bands
    between half the Nyquist frequency and that frequency. Noise that a filter has cut off there
    counts for less.
    """
    if len(x) < _LEAST_SAMPLES:
        return 0.0
    _, power = power_spectrum(x, 1.0)
    bands = np.array_split(power[len(power) // 2 : -1], _BANDS)
    return float(min(band.mean() for band in bands))


def with_added_rounding(
    rig: Rig, record: Record, rng: np.random.Generator, smoother: Smoother
) -> Record:
    """Return the record with rounding errors that are the same in every repeat added.

    They are those of the record's motion, smoothed to remove its own rounding, with the converters'
    steps shifted at random: a slow signal has slow errors, which no filter removes.
    """

    def error(_: str, sensor: AnySensor, x: Array) -> Array:
        shift = rng.uniform() * converter_step(sensor)
        return mean_rounding(sensor, smoother.apply(bridged(x)) + shift)

    return _with_errors(rig, record, error)


def _with_errors(
    rig: Rig, record: Record, error: Callable[[str, AnySensor, Array], Array]
) -> Record:
    channels = dict(record.channels)
    for name in rig.channels:
        if name in channels:
            x = np.asarray(channels[name], dtype=np.float64)
            channels[name] = x + error(name, rig.sensors.of(ch.kind_of(name)[0]), x)
    return replace(record, channels=channels)


def record_moments(
    rig: Rig,
    terms: Sequence[Used],
    conditioned: ConditionedRecord,
    before: Mapping[str, Rows],
    rng: np.random.Generator | None = None,
) -> dict[str, Array]:
    """Return N (k+1, k+1) of [X y] for each family of one record with the rows `before`.

    `rng` draws the noise; by default each step has its own stream, so that the prediction does not
    depend on the order of the records.
    """
    if rng is None:
        rng = np.random.default_rng([0, zlib.crc32(conditioned.record.step.encode())])
    noisy = conditioned.condition_alike(rig, with_added_noise(rig, conditioned.record, rng))
    after = record_rows(rig, terms, noisy.signals, noisy.filtering)
    out: dict[str, Array] = {}
    for name, rows in before.items():
        D = _difference(rows, after[name])
        family = family_of(name)
        out[family] = out.get(family, np.zeros((D.shape[1], D.shape[1]))) + D.T @ D
    return out


def _difference(rows: Rows, other: Rows) -> Array:
    """Return the change of [X y] (m, k+1) in the rows that both have."""
    a, b = in_common(rows, other)
    return np.column_stack((other.matrix[b] - rows.matrix[a], other.rhs[b] - rows.rhs[a]))
