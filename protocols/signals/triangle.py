"""A command that rises and falls at constant slope."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import Waveform, shaped, whole_period
from rig.model.quantity import Frequency

_HIGHEST = 21  # harmonics of a triangle beyond this are below 0.3 % of the first: 1 / k^2


class Triangle(AmplitudeSignal):
    """Between -A and +A at constant slope, so that the speed sweeps every value evenly."""

    kind: Literal["triangle"]
    frequency: Frequency = Field(gt=0)

    def waveform(self, sample_rate: float) -> Waveform:
        """Return whole cycles; raises ValueError where the frequency does not suit the clock."""
        cycles, n = whole_period(self.frequency, sample_rate)
        phase = (cycles * np.arange(n) / n) % 1.0
        wave = 1.0 - 4.0 * np.abs(phase - 0.5)
        return shaped(self.volts * wave, (_HIGHEST + 0.5) * self.frequency, sample_rate)
