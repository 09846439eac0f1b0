"""Thresholds of the identification: checks, estimators, searches, output error, on-line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class IdentifySettings:
    """Limits of checks, choice of estimators, convergence of iterations.

    Those of the estimators were set by `python -m tests.studies estimators`.
    """

    # -- checks of records and result ----------------------------------------------------------
    least_travel: float = 50.0  # of an excited piston, in standard deviations of its noise
    clipped_share: float = 0.01  # of a channel's samples
    lost_share: float = 0.01  # of a run's samples
    most_creep: float = 2e-4  # [m/s] valves closed; the drift that a record of 10 s may have
    masked_share: float = 0.2  # of an equation's rows
    stiffest_liquid: float = 4e9  # [Pa] bulk modulus; oils have up to 2.5e9, water-glycol 3.5e9
    condition_limit: float = 200.0  # scaled columns; the paper's are 10 to 27
    noise_bias: float = 0.01  # relative, of the worst parameter
    rejected_level: float = 0.01  # p value below which the data reject a physical constraint
    bulk_modulus_range: tuple[float, float] = (5e7, 2.5e9)  # [Pa] hoses with air .. mineral oil
    length_tolerance: float = 0.05  # relative, of R12/W2 against l1
    normal_quantile: float = 1.96  # half of a 95 % interval over the standard error, known sigma
    record_segments: int = 10  # parts of a record whose residuals are compared

    # -- experiments that would identify a parameter --------------------------------------
    visible_direction: float = 0.02  # least singular value of a direction that a step determines
    most_poses: int = 81  # of the joints beyond the excited one, for each candidate
    advice_seconds: float = 4.0  # [s] of each candidate's motion
    advice_lines: tuple[tuple[float, float], ...] = (  # [Hz], share of the amplitude
        (0.5, 1.0),
        (1.75, 0.3),
        (4.0, 0.1),
    )
    advice_stroke: float = 0.25  # amplitude of the motion over the stroke

    # -- estimators ----------------------------------------------------------------------------
    lack_of_fit_level: float = 0.01  # p value of the F test below which lack of fit is significant
    instrument_level: float = 0.01  # p value for all parameters together (Bonferroni)
    least_draws: int = 100  # of a bootstrap's 95 % interval
    # Grouping of an equation's rows: parts of one period, bins of its state, averaging [s] of a
    # channel for sorting, shortest part [s] (longer than the row filter remembers noise).
    period_segments: int = 10
    state_levels: int = 8
    averaging_time: float = 0.02
    shortest_segment: float = 0.25
    # Nuisances known beforehand: d ln b / dT [1/K] and its spread; dp_t^2 is 0 +- the square of
    # `transition_drop` [Pa]; drops below `least_drop` of them are beyond the first order and held
    # there; the lead of the spool's path between samples is 0 +- `path_between_samples`
    # intervals; a value more than `implausible_deviations` away is due to another effect.
    bulk_slope: float = -0.003
    bulk_slope_std: float = 0.003
    transition_drop: float = 1e5
    least_drop: float = 2.0
    path_between_samples: float = 0.05
    implausible_deviations: float = 4.0
    # Robust: 95 % efficient on Gaussian noise (Huber, Tukey); leverage in robust deviations of a
    # column from the repeats' median; last relative change; fewer repeats have no median.
    huber: float = 1.345
    tukey: float = 4.685
    leverage_limit: float = 12.0
    robust_rounds: int = 30
    robust_settled: float = 1e-9
    mad_to_std: float = 1.4826  # of Gaussian noise
    least_repeats: int = 3
    few_outliers: float = 0.02  # share of a record's rows, in the worst record
    weight_rounds: int = 2  # of weights from residuals; the first solution is close already
    # A relative shift between estimators matters beyond `shift_limit` (b: its own), or beyond the
    # share `shift_of_interval` of the 95 % half-width and `shift_least` of the limit.
    shift_limit: float = 0.005
    shift_limit_of_b: float = 0.02
    shift_of_interval: float = 0.5
    shift_least: float = 0.1

    # -- other methods -------------------------------------------------------------------------
    stage_precision: float = 0.02  # a step yields a value below this relative 95 % half-width
    worst_shown: int = 3  # disagreements that the check spells out; the table has them all
    failed_error: float = 1e6  # error of a candidate without a state, far above any with one
    idle_value: float = 1.0  # of parameters without effect and without a nominal value
    at_bound: float = 0.02  # of the decades searched: nearer to an end, the bound made the value

    # -- on-line -------------------------------------------------------------------------------
    online_chunk: float = 0.5  # [s] of new samples worked on together; one independent piece
    online_floor: float = 1e-4  # of the largest norm that a column of R has had
    online_spent: float = 1e-6  # weight (exp(-age / memory)) below which a segment is dropped

    # -- output error --------------------------------------------------------------------------
    # Window of a simulation [s]. The measured spool drives it, and its noise is integrated: after a
    # second it moves the piston by as much as its sensor's noise. Of 3, 1 and 0.5 s the shortest
    # was the most exact.
    window: float = 0.5
    window_workers: int = 2  # threads that simulate windows
    window_seconds: float = 150.0  # [s] of all windows; of more data fewer, evenly spread
    point_rate: float = 250.0  # [Hz] at which outputs are compared; channels pass 80 Hz
    sensitivity_step: float = 1e-5  # relative change of a parameter
    start_steps: tuple[float, ...] = (1e-6, 1e-5, 20.0, 20.0)  # [rad, rad/s, Pa, Pa] at the start
    stable_step: float = 2.0  # step times relaxation rate; the fourth-order rule diverges at 2.78
    fit_rounds: int = 8  # most Gauss-Newton steps
    fit_halvings: int = 5  # tries of a step, each half as long
    fit_settled: float = 0.1  # last change of every parameter, in its standard errors
    free_run_step: float = 1e-2  # relative, of a parameter for its slope
    free_run_simulations: int = 60  # of all records, for each parameter
    failed_state: float = 1e3  # [m or rad] in place of a state that ceased to exist
    shape_seconds: float = 8.0  # [s] of windows for a shape: a trace has little time


IDENTIFY: Final = IdentifySettings()
