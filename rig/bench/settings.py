"""Thresholds that no rig file states, of a session with a device and of every check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class BenchSettings:
    """Times and attempts of zeroing, and thresholds of the probe and of the clocks."""

    zero_attempts: int = 2  # attempts to zero the outputs; the second one reopens the wire
    # A device that refuses, as a busy one does, is asked again after a pause, for so long.
    zero_patience: float = 1.0  # [s]
    zero_pause: float = 0.02  # [s]
    zero_seconds: float = 2.0  # of device time with every command at zero, recorded as proof
    queued_seconds: float = 4.0  # of older samples that a device may still hold in its queue
    empty_pressure: float = 0.1e6  # [Pa] gauge below which a chamber counts as without pressure
    late_share: float = 0.5  # [sample periods] after its tick from which on a sample counts as late
    # Twice the error of a crystal, in either direction: the least offset may grow at this rate.
    clock_drift: float = 200e-6  # [s/s]


BENCH: Final = BenchSettings()


@dataclass(frozen=True)
class GuardSettings:
    """Delays and thresholds of the checks.

    "Seen" below is the largest value on the shipped benches, shipped protocols, clean and with
    each shipped effect (`make study NAME=guard`).
    """

    # Single samples
    saturated_samples: int = 5  # consecutive samples that count as saturated
    saturated_samples_vacuum: int = 50  # cavitating oil rests at the low end, but with noise
    max_gap: float = 0.1  # [s] of device time without samples
    stale_after: float | None = None  # [s] of wall time; default: the rig's watchdog
    stale_warning: float = 0.5  # share of `stale_after` that warns

    # Warnings: against chatter
    warning_delay: float = 0.05  # [s] outside the band; five blocks of the shipped bench
    # Hysteresis: share of the band's width; four times the noise of a worn sensor.
    dead_band: float = 0.02
    return_after: float = 1.0  # [s] inside before a warning ends; time for a person to read it

    # Plausibility: features over a window, every `hop`
    window: float = 0.5  # [s]; half of a 1 Hz period, the slowest wave of the seed's protocol
    hop: float = 0.1  # [s] between two windows
    confirm: float = 0.2  # [s] that a finding must last, to exclude transients

    frozen_after: float = 0.25  # [s] that a moving joint's sensor keeps one value
    # Deviation of a spool from its command: of its motion, or constant.
    spool_share: float = 0.5  # of the movement commanded, mean deviation; seen: 0.04
    spool_floor: float = 0.005  # of the stroke, mean deviation; seen: 0.0001
    spool_constant: float = 0.1  # of the stroke; an LVDT's own offset stays below 0.03
    # A chamber of an excited joint that never reaches this share of the set pressure is open.
    empty_chamber: float = 0.03  # seen: 0.13, with external leakage
    supply_lost: float = 0.25  # of the set pressure, while a joint is excited: no load is moved
    open_spool: float = 0.05  # of the stroke, mean; overlap and shift of a null stay below
    still_piston: float = 12.0  # standard deviations, peak to peak; noise alone reaches some 7
    stroke_end: float = 0.02  # of the stroke from its end: a piston there is stopped, not stuck
    above_supply: float = 1.1  # of the supply, mean; seen: 1.03, by a sensor's gain
    drift: float = 0.05  # of limits.speed, mean over the window at zero command; seen: 0.01
    noise: float = 5.0  # times the stated noise; seen: 1.25, by the steps of the converter

    # Swings of a closed cylinder's pressures against each other; sound: within 1.2 of the ratio
    # that its volumes say, correlated by -0.97; plugs exchanged: 10 times off.
    swing_span: float = 1.0  # [s]; a period of 1 Hz
    # Times the noise of a 20 ms mean, standard deviation; smaller swings are not judged.
    swing_noise: float = 5.0
    swing_factor: float = 3.0  # off the ratio either way: the sensor is not of this cylinder
    swing_match: float = 1.5  # off the ratio at most: another joint's sensor is
    swing_phase: float = 0.9  # least correlation of opposite phase
    # Trend of an excited joint's force that its motion does not explain
    trend_span: float = 2.0  # [s]; two periods of 1 Hz
    trend: float = 0.1  # of supply.pressure over the span
    # Share of the variance of time that the motion must not explain: excludes slow ramps.
    trend_alone: float = 0.7
    trend_clear: float = 2.0  # times the residual without it
    trend_other: float = 0.25  # of the drifting sensor's trend, in the other chamber, at most

    # Bands of the bench, where the rig file gives none
    supply_warning: tuple[float, float] = (0.8, 1.15)  # of supply.pressure; seen: 0.97 to 1.01
    oil_warning: float = 2.0  # times oil.temperature_band either way; seen: 1.1
