"""Thresholds by which foreign records are read, and windows written.

Set on the measured machines of docs/emps.md and docs/crane.md, and by the tests of
importing (tests/services/test_importer.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ExchangeSettings:
    """Numbers without unit are shares or counts."""

    file_bytes: int = 4 << 30  # [bytes] of a file of columns, at most
    whole: float = 1e-6  # of a sample: a delay so near to whole samples is one
    uneven: float = 0.1  # of the mean step: what rounded time stamps may differ from it
    trip_seconds: float = 2.0  # [s] before the offending sample, and after it

    # Sensors at the end of their range, and dead ones.
    levels: int = 500  # of resolution within the range; a coarser channel has flat tops anyway
    near: float = 0.02  # of the channel's range, counted from its extreme
    share: float = 0.5  # of the samples near an extreme with its exact value; a parabola: a third
    least: int = 10  # samples at one value before it is reported
    end: float = 1e-3  # of a sensor's range, from its end


EXCHANGE: Final = ExchangeSettings()
