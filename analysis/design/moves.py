"""Changes of one joint's spectrum in the search for a better excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.design.limits import Spectrum
from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, TwinStep

Lines = NDArray[np.int64]

KINDS = ("shape", "bump", "lines", "phases")


@dataclass(frozen=True)
class Tone:
    """Lines that one joint of one step may use, with their complex amplitudes [V].

    `empty` lines stay empty; `spectrum` (lines,) is zero where a line is not used.
    """

    joint: int
    lines: Lines
    spectrum: Spectrum
    empty: tuple[int, ...]

    @property
    def chosen(self) -> tuple[int, ...]:
        """The lines in use."""
        return tuple(int(k) for k in self.lines[np.abs(self.spectrum) > 0])


def mutated(tone: Tone, early: bool, rng: np.random.Generator) -> tuple[Spectrum, int]:
    """Return the tone's spectrum with one random change, and how many simulations to spend on it.

    `early` in a search, large changes are more frequent.
    """
    size, level = np.abs(tone.spectrum), envelope(tone)
    count = len(tone.lines)
    kind = rng.choice(KINDS, p=DESIGN.early_moves if early else DESIGN.late_moves)
    x = np.log(tone.lines / tone.lines[0])
    if kind == "phases":
        spread = rng.uniform(0.1, np.pi)
        rotation = np.exp(1j * spread * rng.uniform(-1, 1, count))
        return np.asarray(tone.spectrum * rotation), 2
    if kind == "bump":
        middle, width = rng.uniform(x[0], x[-1]), rng.uniform(0.08, 0.6)
        height = 0.7 * rng.standard_normal()
        size = size * np.exp(height * np.exp(-0.5 * ((x - middle) / width) ** 2))
    elif kind == "lines":
        toggled = rng.random(count) < rng.uniform(0.03, 0.3)
        size = np.where(toggled, np.where(size > 0, 0.0, level), size)
    else:
        size = reshaped(tone, rng)
    if np.count_nonzero(size) < DESIGN.least_lines:
        return tone.spectrum, 1
    random_phases = np.exp(2j * np.pi * rng.random(count))
    old_phases = np.exp(1j * np.angle(tone.spectrum))
    rotation = np.where(np.abs(tone.spectrum) > 0, old_phases, random_phases)
    return np.asarray(size * rotation), 4 if kind == "shape" else 3


def tilted(tone: Tone, tilt: float, rng: np.random.Generator) -> tuple[Spectrum, int]:
    """Return all lines with amplitudes f^-tilt and the tone's power, and simulations to spend."""
    size = tone.lines.astype(np.float64) ** -tilt
    size *= np.linalg.norm(tone.spectrum) / np.linalg.norm(size)
    return np.asarray(size * np.exp(2j * np.pi * rng.random(len(size)))), 4


def reshaped(tone: Tone, rng: np.random.Generator) -> Array:
    """Return amplitudes (lines,) f^-tilt in a random band above the lowest lines, which stay."""
    size = np.abs(tone.spectrum)
    lowest = np.flatnonzero(size > 0)[: DESIGN.anchors]
    count, first = len(size), int(lowest[-1]) + 1
    low, high = np.sort(rng.uniform(size=2) ** [2.0, 0.5]) * (count - first) + first
    inside = (np.arange(count) >= low) & (np.arange(count) < high)
    shape = tone.lines.astype(np.float64) ** -rng.uniform(*DESIGN.tilts) * inside
    power = np.linalg.norm(shape)
    if power == 0:
        return size
    above = np.linalg.norm(size[first:]) or np.linalg.norm(size)
    shape *= above / power * np.exp(0.6 * rng.standard_normal())
    shape[lowest] = size[lowest]
    return np.asarray(shape)


def tone_of(joint: int, wave: Array, empty: Sequence[int]) -> Tone:
    """Return the tone of one period of a command (n,), with the lines it may take."""
    spectrum = np.fft.rfft(wave) * (2.0 / len(wave))
    in_use = np.flatnonzero(np.abs(spectrum) > 1e-6 * np.abs(spectrum).max())
    stride = int(np.gcd.reduce(np.diff(in_use))) if len(in_use) > 1 else 1
    lowest = max(in_use[0] - stride * int((1 - DESIGN.lowest_line) * in_use[0] / stride), 1)
    highest = (
        in_use[-1] + stride * int((DESIGN.highest_line - 1) * in_use[-1] / stride)
        if len(in_use) > 1
        else in_use[-1]
    )
    lines = np.setdiff1d(np.arange(lowest, highest + 1, stride), np.array(empty, dtype=np.int64))
    lines = np.union1d(lines, in_use)
    values = np.where(np.isin(lines, in_use), spectrum[lines], 0.0)
    return Tone(joint, lines.astype(np.int64), values, tuple(empty))


def envelope(tone: Tone) -> Array:
    """Return the amplitude (lines,) of each line, interpolated between the lines in use."""
    size = np.abs(tone.spectrum)
    in_use = size > 0
    return np.asarray(np.interp(tone.lines, tone.lines[in_use], size[in_use]))


def with_tones(step: TwinStep, tones: Mapping[int, Tone]) -> TwinStep:
    """Return the step with the waves of these tones."""
    n, waves, lines = step.period, dict(step.waves), set()
    for joint, tone in tones.items():
        full = np.zeros(n // 2 + 1, dtype=np.complex128)
        full[tone.lines] = tone.spectrum * (n / 2.0)
        waves[joint] = np.asarray(np.fft.irfft(full, n))
        lines |= set(tone.chosen)
    return replace(step, waves=waves, lines=tuple(sorted(lines)))
