"""Random-phase multisines with empty lines for detecting nonlinearity."""

from __future__ import annotations

import math
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import (
    LineNumbers,
    Waveform,
    base_period,
    integers,
    integral,
    start_centred,
    sum_of_lines,
)
from rig.model.quantity import Frequency


class Multisine(AmplitudeSignal):
    """Random-phase multisine; odd lines only and with empty detection lines where asked."""

    kind: Literal["multisine"]
    base_frequency: Frequency = Field(gt=0, description="spacing of the lines, 1 / period")
    f_min: Frequency = Field(gt=0)
    f_max: Frequency = Field(gt=0)
    amplitude_is: Literal["rms", "peak"] = "rms"
    odd: bool = Field(default=True, description="leave even lines empty")
    detection_fraction: float = Field(
        default=0.25, ge=0, le=0.5, description="one random line in each group of 1/fraction"
    )
    detection_lines: tuple[int, ...] | None = Field(
        default=None, description="empty lines by number, instead of detection_fraction"
    )
    tilt: float = Field(default=0.0, ge=-2, le=2, description="amplitude follows f^-tilt")
    seed: int = Field(ge=0, description="of phases and detection lines")
    draws: int = Field(default=50, ge=1, le=1000, description="phase draws; lowest crest wins")

    @model_validator(mode="after")
    def _band(self) -> Self:
        if self.f_max < self.f_min:
            raise ValueError(f"f_max {self.f_max:g} Hz is below f_min {self.f_min:g} Hz")
        if self.f_min < self.base_frequency:
            raise ValueError(
                f"f_min {self.f_min:g} Hz is below base_frequency {self.base_frequency:g} Hz: "
                "there is no line"
            )
        both = {"detection_fraction", "detection_lines"} <= self.model_fields_set
        if both and self.detection_lines is not None:
            raise ValueError("give detection_fraction or detection_lines, not both")
        return self

    def reseeded(self, seed: int) -> Self:
        """Return the multisine with another seed of its phases."""
        return self.model_copy(update={"seed": seed})

    def choose_lines(self, rng: np.random.Generator) -> tuple[LineNumbers, LineNumbers]:
        """Return (excited, detection) line numbers; raises ValueError if no line is left.

        With a fraction, one line at random in every full group of consecutive candidates stays
        empty, so that detection lines cover the band evenly but not periodically.
        """
        slack = 1e-9  # 0.3 Hz / 0.1 Hz is 2.9999999999999996
        first = math.ceil(self.f_min / self.base_frequency - slack)
        last = math.floor(self.f_max / self.base_frequency + slack)
        candidates = np.arange(first, last + 1)
        if self.odd:
            candidates = candidates[candidates % 2 == 1]
        if self.detection_lines is not None:
            empty = np.array(sorted(set(self.detection_lines)), dtype=np.int64)
        elif self.detection_fraction > 0.0:
            size = max(2, round(1.0 / self.detection_fraction))
            starts = np.arange(0, len(candidates) - size + 1, size)
            empty = candidates[starts + rng.integers(0, size, len(starts))]
        else:
            empty = np.array([], dtype=np.int64)
        excited = np.setdiff1d(candidates, empty)
        if len(excited) == 0:
            raise ValueError(
                f"no line is left between {self.f_min:g} and {self.f_max:g} Hz "
                f"at {self.base_frequency:g} Hz spacing"
            )
        return excited.astype(np.int64), empty

    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period of u[n] = sum_k A_k cos(2 pi k n / N + phi_k), phi_k uniform.

        A_k follows f^-tilt and is scaled to the asked rms or peak. Of `draws` sets of phases the
        one is kept whose crest factors of command and of piston motion have the lowest product:
        stroke and voltage both limit the amplitude. Equal seeds result in equal samples. Raises
        ValueError where the period is not a whole number of samples or a line is beyond Nyquist.
        """
        n = base_period(self.base_frequency, sample_rate)
        rng = np.random.default_rng(self.seed)
        lines, empty = self.choose_lines(rng)
        if lines[-1] >= n // 2:
            raise ValueError(f"f_max {self.f_max:g} Hz is beyond half the sample rate")
        weight = lines.astype(np.float64) ** -self.tilt
        phases = rng.uniform(0.0, 2.0 * np.pi, (self.draws, len(lines)))
        waves = [sum_of_lines(n, lines, weight * np.exp(1j * phase)) for phase in phases]
        # All draws have the same rms of command and motion, so that comparing peaks is sufficient.
        wave = min(waves, key=lambda w: float(np.ptp(w) * np.ptp(integral(w, lines))))
        size = np.sqrt(np.mean(wave**2)) if self.amplitude_is == "rms" else np.max(np.abs(wave))
        wave = wave * (self.volts / size)
        return Waveform(start_centred(wave, lines), integers(lines), integers(empty))
