"""Thresholds of simulation and validation: unit, meaning, origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class SimulationSettings:
    """Tolerances of the integrator, windows of validation, generation of synthetic records.

    The smallest step of the integrator is compiled into its loop (`integrator.MIN_STEP`).
    """

    # Local error allowed in a step; the absolute ones are far below any sensor's resolution.
    relative_tolerance: float = 1e-6
    angle_tolerance: float = 1e-7  # [rad]
    pressure_tolerance: float = 10.0  # [Pa]
    state_tolerance: float = 1e-8  # of an effect's own state, in its unit

    # -- validation ----------------------------------------------------------------------------
    window: float = 0.25  # [s] simulated from a measured state (contract of `validate`)
    start_samples: float = 0.04  # [s] of samples that the first state is fitted to
    start_degree: int = 3  # of the polynomial fitted to them: rates and accelerations exist
    longest_gap: float = 0.05  # [s] of lost samples that a simulation may bridge

    # -- synthetic records ---------------------------------------------------------------------
    trim_rounds: int = 4  # secant steps that centre an open-loop stroke
    lead: float = 2.0  # [s] simulated before the record, for the initial transient to decay
    end_share: float = 0.99  # of half the stroke: where a joint stands that is locked at its end
    # The integrator joins the spool's samples by straight lines, which takes (pi f / rate)^2 / 3
    # of a line's amplitude: 0.01 % of the gains at 1 kHz. The model runs so many times finer.
    oversampling: int = 4

    # -- the twin ------------------------------------------------------------------------------
    # A rig file's guess of a valve's gain is seldom worse than half of it.
    widest_interval: float = 0.5  # half width of b and flow gains, relative, that a twin may have
    # A factor between an identified and a nominal value that only a wrong unit or gain explains:
    # decimal units differ by ten or more, a poor guess or a payload by less than four.
    far_from_nominal: float = 4.0
    # Models within the intervals, a power of two. Eight widen a range by an amount that differs by
    # less than half from that of thirty-two (seed bench identified from four repeats: within 40 %).
    twin_draws: int = 8
    twin_seed: int = 0  # of their signs


SIMULATION: Final = SimulationSettings()
