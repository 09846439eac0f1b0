"""Thresholds for importing foreign records and for writing the window around a trip.

Set on the measured machines of docs/emps.md and docs/crane.md, and by the tests of
importing (tests/services/test_importer.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ExchangeSettings:
    """Numbers without unit are shares or counts."""

    file_bytes: int = 4 << 30  # [bytes], largest size of a file of columns
    whole: float = 1e-6  # of a sample, within which a delay counts as whole samples
    uneven: float = 0.1  # of the mean step: allowed deviation of rounded time stamps
    trip_seconds: float = 2.0  # [s] before the offending sample, and after it

    # Bandwidth of the motion in records without excited lines: the share of the velocity's power
    # below it, how many times the noise's mean power a spectral line must have (noise exceeds 10
    # times once in 22 000 lines), the highest frequency looked at [Hz], and the shortest record [s]
    # that states one.
    velocity_share: float = 0.998
    above_noise: float = 10.0
    highest: float = 30.0
    bandwidth_seconds: float = 6.0

    # Clipped, stuck and constant sensors.
    levels: int = 500  # of resolution within the range; a coarser channel has flat tops anyway
    near: float = 0.02  # of the channel's range, counted from its extreme
    share: float = 0.5  # of the samples near an extreme with its exact value; a parabola: a third
    least: int = 10  # samples at one value before it is reported
    end: float = 1e-3  # of a sensor's range, from its end
    outliers: float = 0.01  # of a channel's samples: so few beyond the range are taken as lost
    stuck_travel: float = 0.2  # of the piston's travel, while a pressure keeps one exact value
    least_part: float = 2e-3  # of a sensor's range: free joints move, pressures are higher


EXCHANGE: Final = ExchangeSettings()
