"""A sine whose frequency runs up and down again."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import Waveform, seconds_to_samples, shaped
from rig.model.quantity import Frequency, Time


class Chirp(AmplitudeSignal):
    """A sin(phase(t)), its frequency linear from `f_min` to `f_max` and back within `period`.

    Up and down, so that periods join without a jump of frequency; `f_max` is changed slightly to
    obtain the whole number of cycles that this needs.
    """

    kind: Literal["chirp"]
    f_min: Frequency = Field(gt=0, description="where a period begins and ends")
    f_max: Frequency = Field(gt=0, description="reached in the middle of a period")
    period: Time = Field(gt=0, description="up and down")

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if self.f_max <= self.f_min:
            raise ValueError(f"f_max {self.f_max:g} Hz is not above f_min {self.f_min:g} Hz")
        if self.f_min * self.period < 1.0:
            raise ValueError(
                f"f_min {self.f_min:g} Hz has no whole cycle in a period of {self.period:g} s"
            )
        return self

    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period; raises ValueError where it is not a whole number of samples."""
        n = seconds_to_samples(self.period, sample_rate, "period")
        t = np.arange(n) / n
        cycles = max(1, round(0.5 * (self.f_min + self.f_max) * self.period))
        low = self.f_min * self.period
        high = 2.0 * cycles - low
        frequency = low + (high - low) * (1.0 - np.abs(2.0 * t - 1.0))
        phase = np.concatenate(([0.0], np.cumsum(0.5 * (frequency[1:] + frequency[:-1])))) / n
        wave = shaped(np.sin(2 * np.pi * phase), 1.5 * self.f_max, sample_rate)
        peak = float(np.max(np.abs(wave.samples)))
        return Waveform(wave.samples * (self.volts / peak), wave.lines)
