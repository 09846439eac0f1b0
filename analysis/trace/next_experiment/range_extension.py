"""Excitations that go beyond the records where no effect explains: by range or by lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.trace.clues.variables import variables
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.next_experiment.discrimination import MeasurementView
from analysis.trace.next_experiment.excitations import CandidateExcitation
from analysis.trace.result import Dependence
from analysis.trace.settings import EXPERIMENT

LINES: Final = "lines"
TIME: Final = "time"  # no excitation extends it


@dataclass(frozen=True)
class RangeExtension:
    """An excitation, by its index, with `times` the records' range of a variable."""

    index: int
    variable: str
    times: float
    equation: str
    words: str


def wider_range(
    train_data: RegressionData,
    moves: Sequence[Dependence],
    views: Sequence[MeasurementView],
    least: float,
) -> RangeExtension | None:
    """Return the excitation with the widest range of a clue's variable, None if none is wider.

    The first clue in `moves` is used for which an excitation reaches `least` times the range of the
    records.
    """
    for clue in moves:
        joint = int(clue.equation.rsplit("_", 1)[1]) - 1
        own = [s for s in train_data.records if joint + 1 not in s.record.locked]
        for name in (n for n in (clue.variable, clue.by) if n and n != TIME):
            seen = [variables(train_data.rig, s.signals, joint).get(name) for s in own]
            values = [v for v in seen if v is not None]
            if not values:
                continue
            low, high = np.percentile(np.concatenate(values), [1, 99])
            reach = [
                _range_ratio(train_data, view, joint, name, float(low), float(high))
                for view in views
            ]
            k = int(np.argmax(reach))
            if reach[k] >= least:
                words = (
                    f"covers {reach[k]:.1f} times the range of {name}, on which the remaining "
                    "residual depends"
                )
                return RangeExtension(k, name, reach[k], clue.equation, words)
    return None


def _range_ratio(
    train_data: RegressionData,
    view: MeasurementView,
    joint: int,
    name: str,
    low: float,
    high: float,
) -> float:
    """Return a variable's range in records and candidate together over that in the records."""
    if joint + 1 in view.conditioned.record.locked:
        return 0.0
    least, most = np.percentile(variables(train_data.rig, view.signals, joint)[name], [1, 99])
    return float((max(most, high) - min(least, low)) / max(high - low, 1e-30))


def more_lines(
    train_data: RegressionData, moves: Sequence[Dependence], tried: Sequence[CandidateExcitation]
) -> RangeExtension | None:
    """Return the excitation with most lines where the records of the clue's joint have few.

    A single sine gives one path through a nonlinearity, which many forms fit equally well.
    """
    equation = moves[0].equation
    joint = int(equation.rsplit("_", 1)[1]) - 1
    held = [len(s.record.lines) for s in train_data.records if joint + 1 not in s.record.locked]
    counts = [
        len(measured.tones[joint].lines) if joint in measured.tones else 0 for measured in tried
    ]
    if not held or not min(held) or not counts:
        return None
    k = int(np.argmax(counts))
    times = counts[k] / max(held)
    if times < EXPERIMENT.line_ratio:
        return None
    words = f"excites joint {joint + 1} at {counts[k]} frequencies instead of {max(held)}"
    return RangeExtension(k, LINES, times, equation, words)
