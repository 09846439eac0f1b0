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
    delay_tolerance: float = 1e-6  # of a sample, within which a delay counts as whole samples
    step_deviation: float = 0.1  # of the mean step: allowed deviation of rounded time stamps
    trip_seconds: float = 2.0  # [s] before the offending sample, and after it

    # Bandwidth of the motion in records without excited lines: the share of the velocity's power
    # below it, the expected number of lines of noise in a channel that count as motion (one of
    # them gives a bench rows for ten times its motion), the highest frequency examined [Hz], and
    # the shortest record [s] that states one.
    velocity_share: float = 0.998
    noise_lines: float = 1e-4
    highest_bandwidth: float = 15.0
    bandwidth_seconds: float = 6.0
    narrowed: float = 0.7  # of the stated bandwidth: up to this, the measured one is reported

    # Clipped, stuck and constant sensors.
    fewest_levels: int = 500  # in the range; a channel with fewer has flat tops anyway
    near_extreme: float = 0.02  # of the channel's range, counted from its extreme
    clipped_share: float = 0.5  # of samples near an extreme equal to it; a parabola: a third
    fewest_equal: int = 10  # samples at one value before it is reported
    end_share: float = 1e-3  # of a sensor's range, from its end
    outlier_share: float = 0.01  # of a channel's samples: up to this, those out of range are lost
    stuck_travel: float = 0.2  # of the piston's travel, while a pressure keeps one exact value
    smallest_span: float = 2e-3  # of a sensor's range: free joints move, pressures are higher


EXCHANGE: Final = ExchangeSettings()
