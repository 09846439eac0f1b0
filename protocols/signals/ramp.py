"""Slow ramps of the command, each away from zero and back."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import Waveform, seconds_to_samples, shaped
from rig.model.quantity import Time

_CORNER = 40.0  # lines up to so many times 1 / rise keep the corners to 1 % of the amplitude


class Ramp(AmplitudeSignal):
    """0 to +A in `rise`, held for `hold`, back to 0, rest; then the same to -A.

    With a small amplitude the spool passes its null slowly, where dead band, leakage and static
    friction are visible.
    """

    kind: Literal["ramp"]
    rise: Time = Field(gt=0, description="from zero to the amplitude")
    hold: Time = Field(default=0.0, ge=0, description="at the amplitude")
    rest: Time = Field(default=0.0, ge=0, description="at zero between two ramps")

    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period; raises ValueError where a time is not a whole number of samples."""
        rise = seconds_to_samples(self.rise, sample_rate, "rise")
        hold, rest = (
            seconds_to_samples(getattr(self, name), sample_rate, name) if getattr(self, name) else 0
            for name in ("hold", "rest")
        )
        slope = (np.arange(rise) + 0.5) / rise
        half = np.concatenate((slope, np.ones(hold), slope[::-1], np.zeros(rest)))
        wave = np.concatenate((half, -half))
        return shaped(self.volts * wave, _CORNER / self.rise, sample_rate)
