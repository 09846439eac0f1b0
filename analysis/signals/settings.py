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
    # Pass band edge [Hz] of a velocity whose sign is the direction of motion. Noise of the whole
    # band makes |v| too large about each reversal: 5 mm/s of it beside slopes of 91 and 0 kN s/m
    # made a weight 0.5 % too small.
    direction_cutoff: float = 20.0
    # Pass band edges [Hz] of a path along which dry friction reverses. The widest is taken that
    # leaves noise of at most `path_noise` of the joint's rms speed, none where all leave less:
    # noise reverses the contact at rest (with 14 um above 40 Hz the friction left 3 noise floors
    # and was 13 % too large), and a narrow filter rounds the path at reversals (10 Hz made a
    # presliding of 0.04 mm 15 times too large). Noise is measured from `path_noise_from` [Hz] on.
    path_cutoffs: tuple[float, ...] = (40.0, 28.0, 20.0, 14.0, 10.0)
    path_noise: float = 0.03
    path_noise_from: float = 40.0
    # Half-width [samples] of the kernel that interpolates a multiplexed channel.
    align_half_width: int = 16
    # A locked joint moves where the rms of its acceleration within the widest of `moving_bands`
    # [Hz] exceeds `moving_ratio` times that of the stated sensor noise, or within any of them
    # `common_ratio` times that of the noise as measured by the repeats, if smaller: a narrow band
    # has few independent samples. The first `deciding_samples` decide, of the repeats that have at
    # least `deciding_share` of the longest one's samples.
    moving_bands: tuple[float, ...] = (15.0, 5.0, 2.0)
    moving_ratio: float = 1.2
    common_ratio: float = 2.0
    deciding_samples: int = 120_000
    deciding_share: float = 0.5


SIGNALS: Final = SignalSettings()
