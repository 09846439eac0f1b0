"""Thresholds of building, reducing and solving rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class RegressionSettings:
    """Row filter, memory of a reduction, rank rules and limits of the iterative solvers."""

    # Row filter [Hz]: its cutoff where neither excited lines nor the motion's bandwidth are known,
    # the range it stays within, and its ratio to the highest excited line or the bandwidth
    # otherwise; noise grows with its 5th power. A bandwidth can only narrow the filter.
    row_cutoff: float = 15.0
    row_cutoff_range: tuple[float, float] = (8.0, 30.0)
    lines_factor: float = 1.5
    # Of a slow machine the range begins at these ratios to the highest of at least
    # `multisine_lines` lines, or to the bandwidth: above, noise outweighs the harmonics. A
    # crane excited to 0.8 Hz has its inertias within 0.4 % at 3.2 Hz and not at 8 Hz; at 3 times
    # 2 Hz, friction by pressure resembled one of two levels. A record of fewer lines has its
    # information in the harmonics.
    slow_lines: float = 4.0
    slow_bandwidth: float = 3.0
    multisine_lines: int = 3
    # An electric joint's rows need one derivative less of noisy signals, and its friction reverses
    # within milliseconds: a narrower filter attenuates the reversals (`python -m tests.studies
    # emps`).
    row_cutoff_electric: float = 30.0
    # A row is dropped where more than this share of the filter's weight is on masked samples.
    masked_share: float = 1e-3

    # Samples read at a time: two joints then need about 150 MB.
    chunk_samples: int = 120_000
    # Rows of one QR update: times 10 columns 0.3 MB, within a second-level cache; the time is flat
    # from 1024 to 16384.
    block_rows: int = 4096

    # Smallest over largest singular value of the scaled matrix. A direction below it is a thousand
    # times weaker than the strongest; in measured records such directions consist of noise.
    rank_tolerance: float = 1e-3
    # The same of normal equations X'X, where rounding alone sets the limit.
    rank_tolerance_normal: float = 1e-12

    # A parameter counts as undetermined where noise makes more than this share of its column's
    # information, or where more than this share of it lies in a null direction.
    noise_share: float = 0.1
    null_share: float = 0.05
    # Ratio of white noise in a record to a sensor's stated noise, from which the former counts:
    # below, chance and the upper end of a motion's spectrum may make the difference.
    stated_ratio: float = 1.5
    # Lower end of the octave in which rows show their noise, over the row filter's cutoff: that
    # filter stops there.
    octave_above: float = 1.6
    # Samples between rows used for identifiability: neighbouring rows are nearly equal.
    sample_step: int = 5
    # Coefficients of a base parameter: left out below this share of the largest one; written as a
    # whole number where they differ from it by less.
    negligible_share: float = 0.02
    rounding_share: float = 0.02

    # Nonlinear least squares: rounds, and the last step over the largest parameter.
    rounds: int = 30
    tolerance: float = 1e-10
    # Interior-point method: duality gap over |y|^2, factor from one point of the central path to
    # the next, Newton steps; a constraint is active within this share of its unconstrained size.
    duality_gap: float = 1e-13
    path_factor: float = 15.0
    newton_steps: int = 60
    active_share: float = 1e-5


REGRESSION: Final = RegressionSettings()
