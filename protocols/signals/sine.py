"""A single line."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import Waveform, start_centred, whole_period
from rig.model.quantity import Frequency


class Sine(AmplitudeSignal):
    """One line: A sin(2 pi f t)."""

    kind: Literal["sine"]
    frequency: Frequency = Field(gt=0)

    def waveform(self, sample_rate: float) -> Waveform:
        """Return the shortest whole number of cycles that is a whole number of samples.

        Raises ValueError where the frequency does not suit the sample rate.
        """
        cycles, n = whole_period(self.frequency, sample_rate)
        wave = self.volts * np.sin(2.0 * np.pi * cycles * np.arange(n) / n)
        return Waveform(start_centred(wave, np.array([cycles])), (cycles,))
