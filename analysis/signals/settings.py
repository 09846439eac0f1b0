"""Thresholds of filtering, conditioning and the decision which joints move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class SignalSettings:
    """Bands of the filters and the test of a lock (`python -m tests.studies differentiation`)."""

    # Filter of every channel: pass band edge and width to the stop band [Hz], and the attenuation
    # there [dB]: 1e-4, below the noise of 16-bit sensors.
    channel_cutoff: float = 80.0
    channel_transition: float = 40.0
    attenuation: float = 80.0
    # Half-width [samples] of the kernel that interpolates a multiplexed channel.
    align_half_width: int = 16
    # A locked joint moves where the rms of its acceleration within `moving_band` [Hz] exceeds
    # `moving_ratio` times that of sensor noise alone; the first `deciding_samples` decide.
    moving_ratio: float = 1.2
    moving_band: float = 15.0
    deciding_samples: int = 120_000


SIGNALS: Final = SignalSettings()
