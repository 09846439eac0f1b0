"""A signal of chosen lines, as written by the design of experiments."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from protocols.language.signal import SignalKind
from protocols.language.waveforms import Waveform, base_period, start_centred, sum_of_lines
from rig.model.quantity import Angle, Frequency, Voltage


class Lines(SignalKind):
    """Chosen lines with an amplitude and a phase each: sum_k A_k cos(2 pi k f0 t + phi_k)."""

    kind: Literal["lines"]
    base_frequency: Frequency = Field(gt=0, description="spacing of the lines, 1 / period")
    lines: tuple[int, ...] = Field(min_length=1, description="numbers of the excited lines")
    amplitudes: tuple[Voltage, ...] = Field(description="peak of each line [V]")
    phases: tuple[Angle, ...] = Field(description="of each line's cosine [rad]")
    detection_lines: tuple[int, ...] = Field(default=(), description="lines left empty on purpose")

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        for name, values in (("amplitudes", self.amplitudes), ("phases", self.phases)):
            if len(values) != len(self.lines):
                raise ValueError(f"{name} has {len(values)} entries for {len(self.lines)} lines")
        if any(a <= 0 for a in self.amplitudes):
            raise ValueError("amplitudes must be above zero; leave a line out instead")
        if self.lines[0] < 1 or any(a >= b for a, b in pairwise(self.lines)):
            raise ValueError("lines must be numbers from 1 on in rising order")
        twice = sorted(set(self.lines) & set(self.detection_lines))
        if twice:
            raise ValueError(f"line {twice[0]} is excited and a detection line; expected only one")
        return self

    def scaled(self, factor: float) -> Self:
        """Return the lines with every amplitude multiplied."""
        return self.model_copy(update={"amplitudes": tuple(factor * a for a in self.amplitudes)})

    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period, rotated to start centred as every waveform is.

        Raises ValueError where the period is not a whole number of samples or a line is beyond
        Nyquist.
        """
        n = base_period(self.base_frequency, sample_rate)
        lines = np.array(self.lines, dtype=np.int64)
        if lines[-1] >= n // 2:
            raise ValueError(f"line {lines[-1]} is beyond half the sample rate")
        amplitudes = np.array(self.amplitudes) * np.exp(1j * np.array(self.phases))
        wave = start_centred(sum_of_lines(n, lines, amplitudes), lines)
        return Waveform(wave, self.lines, tuple(sorted(self.detection_lines)))


def chosen_lines(wave: Waveform, base_frequency: float) -> Lines:
    """Return the chosen lines that make this waveform: amplitudes and phases from its spectrum."""
    spectrum = np.fft.rfft(wave.samples)[list(wave.lines)] * (2.0 / wave.period)
    return Lines(
        kind="lines",
        base_frequency=base_frequency,
        lines=wave.lines,
        amplitudes=tuple(float(a) for a in np.abs(spectrum)),
        phases=tuple(float(a) for a in np.angle(spectrum)),
        detection_lines=wave.detection_lines,
    )
