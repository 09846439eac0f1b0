"""Thresholds of predicting and designing experiments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class DesignSettings:
    """Margins of a design on the twin, moves of the search, start of the twin."""

    # Limits: share of the supply kept from tank and supply pressure, share of a closed lock's
    # tolerance used (beyond half of it the engine closes it again).
    pressure_margin: float = 0.03
    lock_share: float = 0.6
    # Peaks are clipped at this share of the worst signal's in the search for phases.
    peak_clip: float = 0.85

    # Lines of a new shape: times the protocol's highest and lowest, tilts t of amplitudes f^-t, how
    # many of the lowest are kept (they move the piston and so centre it), and the fewest of a tone.
    highest_line: float = 1.6
    lowest_line: float = 0.6
    tilts: tuple[float, float] = (-0.8, 1.3)
    anchors: int = 4
    least_lines: int = 3
    # How often each kind of move (shape, bump, lines, phases) is tried, early and late.
    early_moves: tuple[float, ...] = (0.6, 0.2, 0.1, 0.1)
    late_moves: tuple[float, ...] = (0.15, 0.35, 0.25, 0.25)
    early_share: float = 0.6  # of the budget
    first_tilts: tuple[float, ...] = (0.0, 0.5, -0.5)  # tried on every tone before anything random

    # Share of the tightest limit that a design uses on the twin; below `near_fill` of it a
    # candidate is scaled up and simulated again, above `over_fill` down, by `largest_scaling` at
    # most.
    fill: float = 0.95
    near_fill: float = 0.93
    over_fill: float = 1.02
    largest_scaling: float = 3.0
    # A parameter's error may grow to this multiple of its first, or more while it stays smaller
    # than the first error of the criterion's parameter.
    kept_error: float = 1.5
    phase_rounds: int = 40  # of the search for phases, for each candidate
    gain_band: float = 0.2  # of the logarithm of a piston's gain, needed to centre it

    # Relative fall of a mineral oil's bulk modulus [1/K], about 0.4 to 0.6 % (Merritt,
    # Hydraulic Control Systems, ch. 2); the swing of `oil.temperature_band` is taken as a sine's.
    bulk_fall: float = 0.005
    seed: int = 0  # of the noise whose share in the rows is judged
    # Draws of the instants at which a host takes its samples, and their spread [s] where neither
    # the rig file nor a measurement states it: a desktop's sleep and one exchange over Ethernet.
    late_draws: int = 8
    jitter: float = 1e-3
    # Step of a finite difference over the noise that the filtered signal still carries.
    noise_step: float = 0.1

    # Twin: simulated time [s] before the record (its start has faded then) and growth of the
    # waveform [s]; simulations to centre a piston, drift [m] left, distance [m] from an end.
    lead: float = 3.0
    ramp: float = 1.0
    trims: int = 4
    drift: float = 0.5e-3
    end_distance: float = 1e-4


DESIGN: Final = DesignSettings()
