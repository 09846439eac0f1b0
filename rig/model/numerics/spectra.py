"""The noise of a channel by its spectrum, above the frequencies of the motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def power_spectrum(x: Array, rate: float) -> tuple[Array, Array]:
    """Return frequencies (m,) [Hz] and the power (m,) [SI^2] of samples x (n,) at a rate [Hz].

    It is |F(w (x - mean))|^2 / sum w^2 with Hann's window w, whose mean is the variance of a sample
    where x is white noise (Welch 1967). The window keeps a motion out of higher frequencies.
    """
    window = np.hanning(len(x))
    power = np.abs(np.fft.rfft((x - np.mean(x)) * window)) ** 2 / np.sum(window**2)
    return np.asarray(np.fft.rfftfreq(len(x), 1.0 / rate)), np.asarray(power)


def noise_power(frequency: Array, power: Array, lowest: float) -> float:
    """Return the mean power of noise in a spectrum above `lowest` [Hz], in its strongest octave.

    The noise of a sensor with a filter falls with frequency. The power of noise is exponentially
    distributed about its mean, so that this is the median / ln 2, which no single line changes.
    """
    lowest = min(lowest, 0.5 * float(frequency[-1]))
    octave = np.floor(np.log2(np.maximum(frequency, 1e-9) / lowest))
    medians = [np.median(power[octave == k]) for k in np.unique(octave[octave >= 0.0])]
    return float(max(medians)) / float(np.log(2.0))
