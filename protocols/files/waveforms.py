"""Excitation: one period of a waveform at the rig's sample rate, and the lines it excites.

Source: Pintelon and Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed.
(2012), ch. 4 (random-phase odd multisines with random detection lines, crest factor).
Glossary: line k is the frequency k / period; the crest factor is peak / rms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from protocols.files.schema import Lines as ChosenLines
from protocols.files.schema import Multisine, Signal, Sine

Array = NDArray[np.float64]
Lines = NDArray[np.int64]
MAX_CYCLES = 1000  # of a sine in one waveform; beyond, its frequency does not suit the clock


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

    @property
    def crest_factor(self) -> float:
        """Peak over rms."""
        return float(np.max(np.abs(self.samples)) / np.sqrt(np.mean(self.samples**2)))


def whole_period(frequency: float, sample_rate: float) -> tuple[int, int]:
    """Return the least (cycles, samples) with cycles / frequency = samples / sample_rate.

    A period of 3 Hz is 333.3 samples of 1 ms, but three periods are exactly 1000.
    Raises ValueError where more than `MAX_CYCLES` cycles were needed.
    """
    ratio = Fraction(sample_rate).limit_denominator(10**9) / Fraction(frequency).limit_denominator(
        10**6
    )
    cycles, samples = ratio.denominator, ratio.numerator
    if cycles > MAX_CYCLES:
        raise ValueError(
            f"{frequency:g} Hz never meets the sample clock of {sample_rate:g} Hz within "
            f"{MAX_CYCLES} cycles; choose a frequency whose period is a whole number of samples"
        )
    return cycles, samples


def integral(samples: Array, lines: Lines) -> Array:
    """Return the zero-mean integral over a period of 1 s, taken line by line, shape (n,).

    A piston integrates the valve command, so this is the shape of its motion.
    """
    n = len(samples)
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.fft.rfft(samples)[lines] / (2j * np.pi * lines)
    return np.asarray(np.fft.irfft(spectrum, n), dtype=np.float64)


def start_centred(samples: Array, lines: Lines) -> Array:
    """Rotate a waveform so that its integral starts at its own mean, rising.

    Started so, a piston moves about the place where it stood at rest.
    """
    motion = integral(samples, lines)
    rising = np.flatnonzero((motion <= 0.0) & (np.roll(motion, -1) > 0.0))
    return np.asarray(np.roll(samples, -int(rising[0])), dtype=np.float64)


def make_sine(signal: Sine, sample_rate: float) -> Waveform:
    """Make the shortest whole number of cycles that is a whole number of samples.

    Raises ValueError where the frequency does not suit the sample rate.
    """
    cycles, n = whole_period(signal.frequency, sample_rate)
    wave = signal.amplitude * np.sin(2.0 * np.pi * cycles * np.arange(n) / n)
    return Waveform(start_centred(wave, np.array([cycles])), (cycles,))


def choose_lines(signal: Multisine, rng: np.random.Generator) -> tuple[Lines, Lines]:
    """Return (excited, detection) line numbers; raises ValueError if no line is left.

    With a fraction, one line at random in every full group of consecutive candidates stays
    empty, so that detection lines cover the band evenly and yet without a pattern.
    """
    slack = 1e-9  # 0.3 Hz / 0.1 Hz is 2.9999999999999996
    first = math.ceil(signal.f_min / signal.base_frequency - slack)
    last = math.floor(signal.f_max / signal.base_frequency + slack)
    candidates = np.arange(first, last + 1)
    if signal.odd:
        candidates = candidates[candidates % 2 == 1]
    if signal.detection_lines is not None:
        empty = np.array(sorted(set(signal.detection_lines)), dtype=np.int64)
    elif signal.detection_fraction > 0.0:
        size = max(2, round(1.0 / signal.detection_fraction))
        starts = np.arange(0, len(candidates) - size + 1, size)
        empty = candidates[starts + rng.integers(0, size, len(starts))]
    else:
        empty = np.array([], dtype=np.int64)
    excited = np.setdiff1d(candidates, empty)
    if len(excited) == 0:
        raise ValueError(
            f"no line is left between {signal.f_min:g} and {signal.f_max:g} Hz "
            f"at {signal.base_frequency:g} Hz spacing"
        )
    return excited.astype(np.int64), empty


def make_multisine(signal: Multisine, sample_rate: float) -> Waveform:
    """Make one period of u[n] = sum_k A_k cos(2 pi k n / N + phi_k), phi_k uniform.

    A_k follows f^-tilt and is scaled to the asked rms or peak. Of `draws` sets of phases the one
    is kept whose crest factors of command and of piston motion have the lowest product: the
    stroke binds as much as the voltage does. The same seed gives the same samples. Raises
    ValueError where the period is not a whole number of samples or a line is beyond Nyquist.
    """
    n = _period(signal.base_frequency, sample_rate)
    rng = np.random.default_rng(signal.seed)
    lines, empty = choose_lines(signal, rng)
    if lines[-1] >= n // 2:
        raise ValueError(f"f_max {signal.f_max:g} Hz is beyond half the sample rate")
    weight = lines.astype(np.float64) ** -signal.tilt
    phases = rng.uniform(0.0, 2.0 * np.pi, (signal.draws, len(lines)))
    waves = [_sum_of_lines(n, lines, weight * np.exp(1j * phase)) for phase in phases]
    # All draws have the same rms, of command and of motion: comparing the peaks is enough.
    wave = min(waves, key=lambda w: float(np.ptp(w) * np.ptp(integral(w, lines))))
    size = np.sqrt(np.mean(wave**2)) if signal.amplitude_is == "rms" else np.max(np.abs(wave))
    wave = wave * (signal.amplitude / size)
    return Waveform(start_centred(wave, lines), _ints(lines), _ints(empty))


def make_lines(signal: ChosenLines, sample_rate: float) -> Waveform:
    """Make one period of chosen lines, rotated to start centred as every waveform is.

    Raises ValueError where the period is not a whole number of samples or a line is beyond
    Nyquist.
    """
    n = _period(signal.base_frequency, sample_rate)
    lines = np.array(signal.lines, dtype=np.int64)
    if lines[-1] >= n // 2:
        raise ValueError(f"line {lines[-1]} is beyond half the sample rate")
    amplitudes = np.array(signal.amplitudes) * np.exp(1j * np.array(signal.phases))
    wave = start_centred(_sum_of_lines(n, lines, amplitudes), lines)
    return Waveform(wave, _ints(lines), tuple(sorted(signal.detection_lines)))


def chosen_lines(wave: Waveform, base_frequency: float) -> ChosenLines:
    """Return the chosen lines that make this waveform: amplitudes and phases from its spectrum."""
    spectrum = np.fft.rfft(wave.samples)[list(wave.lines)] * (2.0 / wave.period)
    return ChosenLines(
        kind="lines",
        base_frequency=base_frequency,
        lines=wave.lines,
        amplitudes=tuple(float(a) for a in np.abs(spectrum)),
        phases=tuple(float(a) for a in np.angle(spectrum)),
        detection_lines=wave.detection_lines,
    )


def scaled(signal: Signal, factor: float) -> Signal:
    """Return the signal with all its amplitudes multiplied."""
    if isinstance(signal, ChosenLines):
        amplitudes = tuple(factor * a for a in signal.amplitudes)
        return signal.model_copy(update={"amplitudes": amplitudes})
    return signal.model_copy(update={"amplitude": factor * signal.amplitude})


def make_waveform(signal: Signal, sample_rate: float) -> Waveform:
    """Make one period of any signal; raises ValueError as the makers of its kind do."""
    if isinstance(signal, Sine):
        return make_sine(signal, sample_rate)
    if isinstance(signal, ChosenLines):
        return make_lines(signal, sample_rate)
    return make_multisine(signal, sample_rate)


def _period(base_frequency: float, sample_rate: float) -> int:
    cycles, n = whole_period(base_frequency, sample_rate)
    if cycles != 1:
        raise ValueError(
            f"base_frequency {base_frequency:g} Hz: its period is "
            f"{sample_rate / base_frequency:.6g} samples, not a whole number"
        )
    return n


def _sum_of_lines(n: int, lines: Lines, amplitudes: NDArray[np.complex128]) -> Array:
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectrum[lines] = amplitudes * (n / 2.0)
    return np.asarray(np.fft.irfft(spectrum, n), dtype=np.float64)


def _ints(values: Lines) -> tuple[int, ...]:
    return tuple(int(v) for v in values)
