"""Periodic commands in samples, and tools to make them.

Each is uploaded to the device as one period, which repeats. A piston integrates the command of its
valve, so a waveform starts where its integral passes its own mean: a piston at rest then moves
about its initial position.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LineNumbers = NDArray[np.int64]
MAX_CYCLES = 1000  # of a sine in one waveform; with more, its frequency does not suit the clock
LONGEST_PERIOD = 600.0  # [s] a longer waveform, or common period of two, is a mistake
NYQUIST_SHARE = 4.0  # excited lines stay below Nyquist / 4
FAINT = 1e-3  # of the largest line; a smaller one does not count as excited
SMOOTH = 8.0  # lines of a shape with edges end at this many times 1 / the edge's time
LARGEST = 1e100  # [V] of a sample whose spectrum can be computed


@dataclass(frozen=True)
class Waveform:
    """One period of a command [V], shape (n,), the lines it excites and those left empty."""

    samples: Array
    lines: tuple[int, ...]
    detection_lines: tuple[int, ...] = ()

    @property
    def period(self) -> int:
        """Samples until the waveform starts again."""
        return len(self.samples)

    def travel(self, rate: float) -> float:
        """Return the peak of the integral about its mean [V s] at `rate` samples a second."""
        moved = integral(self.samples, np.array(self.lines)) * (self.period / rate)
        return float(0.5 * np.ptp(moved))


def highest_line(sample_rate: float) -> float:
    """Return the frequency [Hz] below which the lines of an excitation stay."""
    return sample_rate / 2.0 / NYQUIST_SHARE


def whole_period(frequency: float, sample_rate: float) -> tuple[int, int]:
    """Return the least (cycles, samples) with cycles / frequency = samples / sample_rate.

    A period of 3 Hz is 333.3 samples of 1 ms, but three periods are exactly 1000.
    Raises ValueError where more than `MAX_CYCLES` cycles were needed, where a cycle has two samples
    or fewer, and where one is longer than `LONGEST_PERIOD`.
    """
    if frequency * LONGEST_PERIOD < 1.0:
        raise ValueError(
            f"{frequency:g} Hz has a period of {1.0 / frequency:g} s; expected at most "
            f"{LONGEST_PERIOD:g} s"
        )
    ratio = Fraction(sample_rate).limit_denominator(10**9) / Fraction(frequency).limit_denominator(
        10**6
    )
    cycles, samples = ratio.denominator, ratio.numerator
    if samples <= 2 * cycles:
        raise ValueError(
            f"excites {frequency:g} Hz; at {sample_rate:g} samples a second stay below "
            f"{highest_line(sample_rate):g} Hz"
        )
    if cycles > MAX_CYCLES:
        raise ValueError(
            f"{frequency:g} Hz never meets the sample clock of {sample_rate:g} Hz within "
            f"{MAX_CYCLES} cycles; choose a frequency whose period is a whole number of samples"
        )
    return cycles, samples


def base_period(base_frequency: float, sample_rate: float) -> int:
    """Return the samples of a period of `base_frequency` [Hz]; ValueError if not a whole number."""
    cycles, n = whole_period(base_frequency, sample_rate)
    if cycles != 1:
        raise ValueError(
            f"base_frequency {base_frequency:g} Hz: its period is "
            f"{sample_rate / base_frequency:.6g} samples, not a whole number"
        )
    return n


def integral(samples: Array, lines: LineNumbers) -> Array:
    """Return the zero-mean integral over a period of 1 s, taken line by line, shape (n,)."""
    n = len(samples)
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.fft.rfft(samples)[lines] / (2j * np.pi * lines)
    return np.asarray(np.fft.irfft(spectrum, n), dtype=np.float64)


def start_centred(samples: Array, lines: LineNumbers) -> Array:
    """Rotate a waveform so that its integral starts at its own mean, rising.

    Raises ValueError for a waveform too large to be computed.
    """
    largest = float(np.max(np.abs(samples)))
    if not largest < LARGEST:
        raise ValueError(f"reaches {largest:g} V; expected an amplitude within limits.command")
    motion = integral(samples, lines)
    rising = np.flatnonzero((motion <= 0.0) & (np.roll(motion, -1) > 0.0))
    return np.asarray(np.roll(samples, -int(rising[0])), dtype=np.float64)


def sum_of_lines(n: int, lines: LineNumbers, amplitudes: NDArray[np.complex128]) -> Array:
    """Return sum_k Re(A_k exp(2 pi j k t / n)), shape (n,)."""
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectrum[lines] = amplitudes * (n / 2.0)
    return np.asarray(np.fft.irfft(spectrum, n), dtype=np.float64)


def shaped(samples: Array, highest: float, sample_rate: float) -> Waveform:
    """Return the waveform of any shape (n,) [V], its mean removed and its lines limited.

    Lines above `highest` [Hz] are removed, and lines below `FAINT` of the largest do not count as
    excited. Raises ValueError for a constant shape.
    """
    n = len(samples)
    if n < 4 or not np.isfinite(samples).all() or np.ptp(samples) == 0.0:
        raise ValueError("its samples do not vary; expected a shape of 4 samples or more")
    spectrum = np.fft.rfft(samples)
    spectrum[0] = 0.0
    top = min(int(highest * n / sample_rate), (n - 1) // 2)
    spectrum[top + 1 :] = 0.0
    size = np.abs(spectrum)
    if not size.any():
        raise ValueError(f"nothing of it lies below {highest:g} Hz")
    lines = np.flatnonzero(size > FAINT * size.max()).astype(np.int64)
    wave = np.asarray(np.fft.irfft(spectrum, n), dtype=np.float64)
    return Waveform(start_centred(wave, lines), integers(lines))


def seconds_to_samples(seconds: float, sample_rate: float, what: str) -> int:
    """Return a time in samples; ValueError naming `what` where it is no whole number."""
    if seconds > LONGEST_PERIOD:
        raise ValueError(f"{what} {seconds:g} s; expected at most {LONGEST_PERIOD:g} s")
    n = seconds * sample_rate
    if round(n) < 1 or abs(n - round(n)) > 1e-6 * max(n, 1.0):
        raise ValueError(f"{what} {seconds:g} s is {n:.6g} samples; expected a whole number")
    return round(n)


def smooth_edge(n: int) -> Array:
    """Return a raised cosine from 0 to 1 in n samples, (n,): 1/2 (1 - cos(pi t))."""
    return np.asarray(0.5 * (1.0 - np.cos(np.pi * (np.arange(n) + 0.5) / n)), dtype=np.float64)


def integers(values: LineNumbers) -> tuple[int, ...]:
    """Return line numbers as plain integers."""
    return tuple(int(v) for v in values)
