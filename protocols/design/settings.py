"""Thresholds by which protocols are generated, sized and proved on the twin.

Set on the shipped rigs, whose generated protocols are run and identified in tests/protocols and
tests/cli; *paper* is the method of docs/method.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ProtocolDesignSettings:
    """Limits and counts of protocol design; numbers without unit are shares or counts."""

    # Candidates.
    exhaustive_joints: int = 3  # beyond the excited one: up to so many, every combination is tried
    most_at_ends: int = 2  # of more joints than that, at most so many at an end stop
    end_tolerance: float = 2e-3  # [m] of a joint locked at its end
    closed_tolerance: float = 5e-3  # [m]: a closed valve is a spring of oil
    amplitude: float = 0.4  # [V] rms to begin with; every step is sized on the twin
    repeats: int = 4  # of each record

    # Sizing.
    amplitude_factor: float = 0.85  # from one amplitude tried to the next
    amplitude_tries: int = 12  # amplitudes tried at most
    tilts: tuple[float, ...] = (0.4, 0.8, 1.2)  # exponents of amplitudes f^-tilt
    low_amplitude: float = 0.25  # [V] rms below which a steeper multisine is tried

    sine_frequencies: tuple[float, ...] = (1.0, 3.0)  # [Hz] of the validation steps (paper)
    sine_alone: float = 1.0  # [V] peak of one moving joint, to begin with
    sine_together: float = 0.7  # [V] peak of several

    # Selection.
    condition: float = 30.0  # condition number that is enough; those of the paper are 10 to 27
    condition_ratio: float = 0.9  # of condition numbers: a further step must bring this or less
    singular_floor: float = 1e-3  # of a unit column: smaller singular values count as zero
    closed_valve_cost: float = 3.0  # in log det: what each further closed valve must add

    # Proof on the twin.
    bias_tries: int = 6  # biases that are tried to centre a piston
    seek_seconds: float = 3.0  # [s] simulated with each bias but the last
    ramp_seconds: float = 1.0  # [s] in which the waveform grows
    settle_seconds: float = 2.0  # [s] simulated before the period that is judged
    drift_share: float = 0.2  # of the drift that the protocol allows
    largest_widening: float = 1.05  # swing with the centring loop over that without, reported above
    sigmas: float = 2.0  # standard deviations from a prediction to the end of its range


DESIGN: Final = ProtocolDesignSettings()
