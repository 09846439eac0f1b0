"""Value, first and second derivative of sampled channels through one zero-phase filter.

Every smoother here is linear and symmetric, so it shifts nothing in time, and the analysis passes
every channel through the same one: only then do the flow and torque balances still hold between
filtered signals (Sakai and Maeshima's causal 20-sample average delays by 9.5 ms).

A smoother is a row of symmetric taps per derivative: y_k = (d/dt)^k (h * x). Filtering happens
twice in the analysis. Products such as sqrt(p_s - p) u or cos(q2) q1'' do not commute with a
filter, so the channels first pass a filter wide enough for all motion of the bench (default 80 Hz),
the rows are built from them point by point, and then WHOLE rows, columns and right-hand side alike,
pass a second low-pass (`row_filter`, default 1.5 times the highest excited line): a linear equation
that holds at every instant still holds after any linear filter. The row filter removes the noise
that differentiation has amplified, and allows decimation without aliasing.
`tests.studies.estimators.differentiation` prints the measured bias and scatter of each choice.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analysis.signals.convolution import convolved, convolved_rows, decimated
from analysis.signals.settings import SIGNALS
from rig.model.numerics.spectra import noise_power, power_spectrum
from rig.model.parse import InputError

Array = NDArray[np.float64]

# Central differences: (first, second) derivative stencils by order of accuracy.
_DIFFERENCES = {
    2: (np.array([-1 / 2, 0, 1 / 2]), np.array([1.0, -2.0, 1.0])),
    8: (
        np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]),
        np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]),
    ),
}


class Smoother(Protocol):
    """A linear zero-phase filter with derivatives; the first and last `reach` samples are edges."""

    @property
    def name(self) -> str:
        """The filter with its settings, for tables and reports."""

    @property
    def reach(self) -> int:
        """Samples on either side that an output depends on."""

    def apply(self, x: Array, order: int = 0) -> Array:
        """Return the filtered (d/dt)^order of x along axis 0, same shape, SI per s^order."""

    def derivatives(self, x: Array, highest: int) -> Sequence[Array]:
        """Return the filtered x (n, c) and its derivatives up to `highest`, each as by `apply`."""


@dataclass(frozen=True)
class FirSmoother:
    """A symmetric finite filter: `taps` (3, 2 reach + 1), one row per derivative 0, 1, 2."""

    name: str
    taps: Array

    @property
    def reach(self) -> int:
        """Samples on either side that an output depends on."""
        return int(self.taps.shape[1] - 1) // 2

    def apply(self, x: Array, order: int = 0) -> Array:
        """Return the filtered (d/dt)^order of x (n, ...); raises InputError if x is too short."""
        level = x[:1]  # subtracted, so that rounding does not change a constant
        out = convolved(_extended(x - level, self.reach, self.name), self.taps[order])
        return out + level if order == 0 else out

    def derivatives(self, x: Array, highest: int) -> Sequence[Array]:
        """Return the filtered x (n, c) and its derivatives up to `highest`, each as by `apply`."""
        level = x[:1]
        wide = _extended(x - level, self.reach, self.name)
        value, *rates = (rows.T for rows in convolved_rows(wide.T, self.taps[: highest + 1]))
        return [value + level, *rates]

    def decimate(self, x: Array, step: int) -> Array:
        """Return every `step`-th filtered sample whose support lies inside x, shape (m, ...)."""
        return decimated(x, self.taps[0], step)


def _extended(x: Array, reach: int, name: str) -> Array:
    """Continue x by point reflection at both ends, which keeps value and slope there."""
    if len(x) <= reach:
        raise InputError(
            f"a record of {len(x)} samples is too short for the filter {name!r}, "
            f"which needs more than {reach}; record longer or take a wider filter"
        )
    before = 2 * x[:1] - x[reach:0:-1]
    after = 2 * x[-1:] - x[-2 : -reach - 2 : -1]
    return np.concatenate((before, x, after))


def _kernel(t: Array, cutoff: float, half_width: float, beta: float) -> Array:
    """Return the continuous kernel of a low-pass: 2 fc sinc(2 fc t) under a Kaiser window."""
    inside = np.clip(1.0 - (t / half_width) ** 2, 0.0, None)
    window = np.where(np.abs(t) <= half_width, np.i0(beta * np.sqrt(inside)) / np.i0(beta), 0.0)
    return np.asarray(2 * cutoff * np.sinc(2 * cutoff * t) * window)


@functools.lru_cache(maxsize=64)
def windowed_sinc(rate: float, cutoff: float, transition: float) -> FirSmoother:
    """Return a Kaiser-windowed sinc: it passes up to `cutoff`, stops from cutoff + transition [Hz].

    Raises InputError where the sample rate does not reach that far. Source: Kaiser's window.
    """
    if cutoff + transition > 0.5 * rate:
        raise InputError(
            f"a filter that passes {cutoff:g} Hz needs a sample rate above "
            f"{2 * (cutoff + transition):g} Hz, not {rate:g} Hz"
        )
    # Kaiser's formulas (Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.6).
    beta = 0.1102 * (SIGNALS.attenuation - 8.7)
    width = 2.285 * 2.0 * math.pi * transition / rate
    count = math.ceil((SIGNALS.attenuation - 7.95) / width + 1.0)
    reach = count // 2 + 1
    t = np.arange(-reach, reach + 1) / rate
    h0 = _kernel(t, cutoff + 0.5 * transition, (reach + 1) / rate, beta)
    smoother = differenced(f"windowed sinc, {cutoff:g} Hz", h0, rate)
    smoother.taps.setflags(write=False)  # the cache returns the same array to all callers
    return smoother


def differenced(name: str, h0: Array, rate: float, order: int = 8) -> FirSmoother:
    """Return taps of a symmetric value filter followed by central differences of `order`."""
    first_stencil, second_stencil = _DIFFERENCES[order]
    padded = np.pad(h0, len(first_stencil) // 2)
    # Convolution reverses the antisymmetric stencil.
    h1 = np.convolve(h0, first_stencil[::-1]) * rate
    h2 = np.convolve(h0, second_stencil) * rate**2
    return FirSmoother(name, np.stack((padded / h0.sum(), h1 / h0.sum(), h2 / h0.sum())))


def moving_average(rate: float) -> FirSmoother:
    """Return the paper's average of 20 samples made zero-phase, with central differences.

    An even average has no middle sample; averaging the two that straddle it gives half weights
    at the ends.
    """
    h0 = np.convolve(np.full(20, 1.0 / 20), [0.5, 0.5])
    return differenced("moving average, 20 samples", h0, rate, order=2)


def butterworth(rate: float, cutoff: float) -> FirSmoother:
    """Return a Butterworth of order 4 run forwards and backwards, with 8th-order differences.

    Its response is cut where it has decayed to 1e-6. `cutoff` [Hz] is -6 dB, both ways together.
    """
    from scipy.signal import butter, sosfiltfilt  # noqa: PLC0415 - loads slowly

    order = 4
    half = int(np.ceil(6 * order * rate / (2 * np.pi * cutoff)))
    impulse = np.zeros(2 * half + 1)
    impulse[half] = 1.0
    h0 = sosfiltfilt(butter(order, cutoff, fs=rate, output="sos"), impulse, padlen=0)
    significant = np.flatnonzero(np.abs(h0) > 1e-6 * np.abs(h0).max())
    half_kept = half - int(significant[0])
    h0 = h0[half - half_kept : half + half_kept + 1]
    return differenced(f"Butterworth, {cutoff:g} Hz", h0 / h0.sum(), rate)


def channel_filter(rate: float) -> FirSmoother:
    """Return the default filter of all channels, with a band scaled down for low sample rates."""
    scale = min(1.0, 0.3 * rate / (SIGNALS.channel_cutoff + SIGNALS.channel_transition))
    return windowed_sinc(rate, SIGNALS.channel_cutoff * scale, SIGNALS.channel_transition * scale)


def row_filter(rate: float, cutoff: float) -> FirSmoother:
    """Return the low-pass of whole rows: passes up to `cutoff` [Hz], stops from 1.6 times that."""
    cutoff = min(cutoff, 0.25 * rate)
    return windowed_sinc(rate, cutoff, 0.6 * cutoff)


def band_filter(rate: float, cutoff: float) -> FirSmoother:
    """Return a filter of whole rows that passes about an octave above `cutoff` [Hz].

    It is the difference of the low-passes of twice `cutoff` and of `cutoff`.
    """
    low, wide = row_filter(rate, cutoff), row_filter(rate, 2.0 * cutoff)
    pad = low.reach - wide.reach
    return FirSmoother(
        f"octave above {cutoff:g} Hz", np.pad(wide.taps, ((0, 0), (pad, pad))) - low.taps
    )


def path_cutoff(s: Array, v: Array, rate: float) -> float:
    """Return the pass band edge [Hz] of a joint's path along which its friction reverses.

    `s` (n,) is the measured path and `v` (n,) its filtered speed. Noise of the power density S
    [m^2/Hz] in s has the speed 2 pi sqrt(S c^3 / 3) below c [Hz] (`SIGNALS.path_noise`). Infinite
    where the path needs no filter, and where it is too short for the narrowest one.
    """
    if len(s) <= row_filter(rate, min(SIGNALS.path_cutoffs)).reach:
        return math.inf
    density = 2.0 * noise_power(*power_spectrum(s, rate), SIGNALS.path_noise_from) / rate

    def noise(edge: float) -> float:
        return 2.0 * math.pi * math.sqrt(density * edge**3 / 3.0)

    widest = SIGNALS.channel_cutoff
    speed = math.sqrt(max(float(np.mean(v**2)) - noise(widest) ** 2, 0.0))
    for edge in (widest, *SIGNALS.path_cutoffs):
        if noise(edge) <= SIGNALS.path_noise * speed:
            break
    return math.inf if edge == widest else edge


def row_step(rate: float, cutoff: float) -> int:
    """Return the decimation that keeps every frequency in the row filter's pass band."""
    return max(1, int(rate / (2 * 1.6 * min(cutoff, 0.25 * rate))))


def align(x: Array, shift: float) -> Array:
    """Return x(n + shift), shift in samples, by Kaiser-windowed sinc interpolation, shape of x.

    Undoes a sensor's delay (shift > 0) and the multiplexer's skew (shift < 0), flat to 0.35 of
    the sample rate.
    """
    if abs(shift) < 1e-9:
        return x
    taps = _interpolation(shift)
    level = x[:1]
    # Convolution reverses the taps.
    return level + convolved(_extended(x - level, len(taps) // 2, "alignment"), taps[::-1])


@functools.lru_cache(maxsize=256)
def _interpolation(shift: float) -> Array:
    """Return the taps (2 reach + 1,) whose product with samples about n is x(n + shift)."""
    whole = int(np.floor(shift + 0.5))
    reach = SIGNALS.align_half_width + abs(whole)
    distance: Array = np.asarray(np.arange(-reach, reach + 1) - shift, dtype=np.float64)
    taps = _kernel(distance, 0.425, SIGNALS.align_half_width + 0.5, 8.0)
    return np.asarray(taps / taps.sum())
