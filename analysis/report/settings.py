"""Amounts and lengths of data that the reports show: unit, meaning, origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ReportSettings:
    """Lengths of plotted data, numbers of points and figures, digits.

    Layout (inches, colours) is in the modules that draw.
    """

    # -- stretches of time that a figure shows ---------------------------------------------------
    record_seconds: float = 10.0  # [s] of a record
    electric_seconds: float = 15.0  # [s] of an electric joint's record: it moves slowly
    free_run_seconds: float = 4.0  # [s] at the end of a free run (the paper's window)
    effect_seconds: float = 4.0  # [s] of a record, before and after an effect is added

    # -- residual spectra ------------------------------------------------------------------------
    spectrum_seconds: float = 4.0  # [s] of a Welch segment: resolves 0.5 Hz with Hann's window
    spectrum_span: float = 500.0  # largest over smallest value drawn
    fewest_lines: int = 10  # multiples of the period drawn: a sine's harmonics too

    # -- how much a figure holds -----------------------------------------------------------------
    most_figures: int = 18  # of one kind; the tables hold all
    line_points: int = 700  # of a line in a card: more than its pixels
    free_run_points: int = 500  # of a free run's line
    scatter_points: int = 1500  # dots of a scatter
    scatter_means: int = 24  # means over bins, drawn on a scatter
    reach_grid: int = 9  # positions of each joint in the tip's reach
    reach_poses: int = 5000  # of all joints together, at most
    # The axis of intervals ends at so many upper quartiles: one wide interval does not hide the
    # others.
    interval_span: float = 12.0

    # -- numbers ---------------------------------------------------------------------------------
    most_digits: int = 6  # no measurement here is more precise


REPORT: Final = ReportSettings()
