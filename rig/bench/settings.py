"""Thresholds of a session with a device (those of the checks: `rig.bench.checks.settings`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class BenchSettings:
    """Times and attempts of zeroing, and thresholds of the probe and of the clocks."""

    zero_attempts: int = 2  # attempts to zero the outputs; the second one reopens the wire
    zero_seconds: float = 2.0  # of device time with every command at zero, recorded as proof
    queued_seconds: float = 4.0  # of older samples that a device may still hold in its queue
    empty_pressure: float = 0.1e6  # [Pa] gauge below which a chamber counts as without pressure
    late_share: float = 0.5  # [sample periods] after its tick from which on a sample counts as late
    # Twice the error of a crystal, in either direction: the least offset may grow at this rate.
    clock_drift: float = 200e-6  # [s/s]


BENCH: Final = BenchSettings()
