"""Thresholds of the engine: positioning, locking, centring, excitation, manual operation.

Set on simulated benches of the shipped rigs; the tests of the engine run with them
(tests/protocols).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class EngineSettings:
    """Times, speeds and shares of the engine."""

    # Placing and locking
    look_seconds: float = 0.1  # [s] of samples behind one mean: noise of 10 um becomes 1 um
    still_speed: float = 1e-3  # [m/s] below this a piston at an end stop counts as at rest
    # One step of a coarse output is about 1 mm/s: the limit cycle of a piston in a loop.
    rocking_speed: float = 3e-3  # [m/s]
    swing_ends: int = 40  # the lowest and highest positions of the looks before a time-out
    integral_share: float = 0.5  # of the remaining error, removed by one correction
    creep_share: float = 0.25  # of the tolerance, that a closed joint may creep during one record
    guard_share: float = 2.0  # of the tolerance at which the engine gives up a lock: a trip
    relock_share: float = 0.5  # of the tolerance; a closed valve with more movement is closed again
    settle_seconds: float = 1.0  # [s] at rest before a position counts, where no time is stated

    # Centring an excited piston
    recentre_share: float = 0.5  # of the offset, removed within the next record
    recentre_cap: float = 0.7  # of the allowed drift: recentring must not look like a drift itself
    drift_tail: float = 0.25  # of a period, over which drift is averaged
    limit_margin: float = 0.5e-3  # [m] kept from a piston limit
    fastest_return: float = 0.03  # [m/s] of a piston brought back before it leaves its limits
    shortest_return: float = 0.5  # [s] for its return
    shortest_line: int = 100  # samples; a slope through less is noise

    # Waveforms
    ramp_step: float = 0.05  # [s] between two sizes of the growing waveform
    ramp_down: float = 0.5  # [s] of shrinking: closing the valve at once would shock a moving arm
    warm_ups: int = 3  # at most; more than one only if the first left the piston off centre
    loosening_factor: float = 0.8  # factor between two position gains while the loop is loosened
    look_ahead: float = 0.1  # [s] between two forecasts
    released_share: float = 0.25  # of the offset allowed, within which the loop is opened

    # Memory and waiting
    spare_seconds: float = 5.0  # [s] of samples kept beyond a record and two periods before it
    estimate_seconds: float = 20.0  # [s] of wall time for the estimator to take the last record

    # Manual operation
    jog_hold: float = 0.25  # [s] of wall time of a jog after one key press
    jog_margin: float = 0.05  # of the width of a joint's limits, distance kept from either limit
    jog_volts: float = 0.15  # [V] of a jog at most: some 25 mm/s on the seed bench
    manual_tolerance: float = 2e-3  # [m] of movement of a locked joint
    manual_idle: float = 300.0  # [s] without a command after which the session ends


ENGINE: Final = EngineSettings()
