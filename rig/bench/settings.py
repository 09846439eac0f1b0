"""Thresholds of a session with a device (those of the checks: `rig.bench.checks.settings`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class BenchSettings:
    """Times and attempts of stopping, and what a probe and the clocks are judged by."""

    zero_attempts: int = 2  # of zeroing the outputs: the second one opens the wire anew
    zero_seconds: float = 2.0  # of device time with every command at zero, recorded as proof
    queued_seconds: float = 4.0  # of samples from before the zeroing that a device may still hold
    empty_pressure: float = 0.1e6  # [Pa] gauge below which a chamber counts as without pressure
    late_share: float = 0.5  # [periods] after its tick from which on a sample counts as late
    # A crystal's error either way, doubled: the earliest arrival so far may age by as much.
    clock_drift: float = 200e-6  # [s/s]


BENCH: Final = BenchSettings()
