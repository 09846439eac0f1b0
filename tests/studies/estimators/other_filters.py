"""Filters that the study of differentiation compares with those of `analysis.signals.filters`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs

from analysis.signals.filters import FirSmoother, differenced

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FourierSmoother:
    """Differentiation in the frequency domain of whole periods, exact where a record is periodic.

    A record drifts and is trimmed between periods, so the line to the sample that would come
    next is taken out first and put back; what a line cannot describe, and the noise of the ends,
    leaks: that, and records that are not whole periods, are why this is not the default.
    """

    rate: float
    cutoff: float

    @property
    def name(self) -> str:
        """What it is, with its settings."""
        return f"Fourier, {self.cutoff:g} Hz"

    @property
    def reach(self) -> int:
        """A leak at the joint of the ends decays over about two periods of the cutoff."""
        return round(2 * self.rate / self.cutoff)

    def apply(self, x: Array, order: int = 0) -> Array:
        """Return the low-passed (d/dt)^order of x (n, ...), x being whole periods plus a line."""
        n = len(x)
        slope = (2 * x[-1] - x[-2] - x[0]) / n
        line = np.multiply.outer(np.arange(n, dtype=np.float64), slope)
        frequency = np.fft.rfftfreq(n, 1 / self.rate)
        gain = np.where(frequency <= self.cutoff, (2j * np.pi * frequency) ** order, 0.0)
        shape = (-1,) + (1,) * (x.ndim - 1)
        smooth = np.fft.irfft(np.fft.rfft(x - line, axis=0) * gain.reshape(shape), n, axis=0)
        if order == 0:
            smooth += line
        elif order == 1:
            smooth += slope * self.rate
        return np.asarray(smooth)

    def derivatives(self, x: Array, highest: int) -> list[Array]:
        """Return the low-passed x (n, c) and its derivatives up to the order `highest`."""
        return [self.apply(x, order) for order in range(highest + 1)]


def savitzky_golay(rate: float, samples: int = 31, degree: int = 4) -> FirSmoother:
    """Return a local polynomial fit of `degree` over an odd number of samples."""
    taps = [savgol_coeffs(samples, degree, deriv=k, delta=1 / rate) for k in range(3)]
    return FirSmoother(f"Savitzky-Golay, {samples} samples", np.stack(taps))


def smoothing_spline(rate: float, cutoff: float) -> FirSmoother:
    """Return the quintic smoothing spline on equal spacing, -6 dB at `cutoff` [Hz].

    It minimises sum (x - f)^2 + lambda int |f^(3)|^2; far from the ends that is convolution with
    a fixed symmetric kernel of frequency response 1 / (1 + (f / f_c)^6), taken to 1e-6.
    Source: Reinsch (1967); Silverman (1984), Spline smoothing: the equivalent variable kernel.
    """
    count = int(2 ** np.ceil(np.log2(64 * rate / cutoff)))
    f = np.fft.rfftfreq(count, 1.0 / rate)
    kernel = np.fft.irfft(1.0 / (1.0 + (f / cutoff) ** 6), count)
    strong = np.flatnonzero(np.abs(kernel[: count // 2]) > 1e-6 * kernel[0])
    around = np.arange(-int(strong[-1]), int(strong[-1]) + 1)
    return differenced(f"smoothing spline, {cutoff:g} Hz", kernel[around], rate)
