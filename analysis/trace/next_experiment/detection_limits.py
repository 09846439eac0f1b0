"""Detection limits: how large an effect may be that the records would not have shown.

With the whitened rows X of the model in use, an effect at its smallest size of interest adds y to
them. Least squares takes the part X d of y, d = X^+ y, into the parameters; only the rest
q = y - X d shows. A residual r then gives the effect's size as q'r / q'q with the standard error
1 / |q| (in units of the smallest size), and the largest size that goes with the records is

    L = |q'r| / q'q + z / |q|,  z the normal quantile of 95 %.

An effect of this size would have moved the parameters by L d without a trace in the residual
(omitted-variable bias; e.g. Greene, Econometric Analysis, section 4.3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values, shapes_of
from analysis.simulation.model import Model
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.next_experiment.discrimination import ComparisonRows, Explanation, smallest
from analysis.trace.result import DetectionLimit
from analysis.trace.search.hypothesis import Hypothesis, parameter_values
from analysis.trace.search.refinement import rebased, tangent
from analysis.trace.settings import TRACE
from rig.model.channels import place_in_words
from rig.model.units import plain, typeset

Array = NDArray[np.float64]


def detection_limits(
    train_data: RegressionData, effects: Sequence[Effect], winner: Hypothesis, model: Model
) -> list[DetectionLimit]:
    """Return the effects that may hide and would change a parameter visibly, the worst first.

    `effects` are the candidates, of which each name is returned once, where it changes most;
    `winner` is the set in use and `model` the model identified with it. A curve that the data
    draw takes what is alike into itself: beside one nothing is asked.
    """
    if any(isinstance(u.term, Effect) and u.term.free for u in winner.effects):
        return []
    rows = ComparisonRows(rebased(train_data, winner.fit) if winner.effects else train_data)
    names, columns = tangent(train_data, winner.fit)
    half = {name: (p.ci95[1] - p.ci95[0]) / 2 for name, p in model.parameters.items()}
    known = {name for name, p in model.parameters.items() if abs(p.value) > 2.0 * half[name]}
    fitted = FittedColumns(names, columns, winner.fit.residual, {n: half[n] for n in known})
    found = [
        limit
        for effect in effects
        if (effect.name, effect.where) not in winner.keys
        and (what := smallest(effect, train_data.rig)) is not None
        and (limit := _limit(rows, what, fitted)) is not None
    ]
    once: dict[str, DetectionLimit] = {}
    for limit in sorted(found, key=lambda f: -f.shift):
        once.setdefault(limit.name, limit)
    return list(once.values())


@dataclass(frozen=True)
class FittedColumns:
    """A fitted model: `columns` (M, p) of `names`, coefficients and shapes, residual (M,).

    `half` are the half-widths of the 95 % intervals of the parameters that are known.
    """

    names: tuple[str, ...]
    columns: Array
    residual: Array
    half: Mapping[str, float]


def _limit(rows: ComparisonRows, what: Explanation, fitted: FittedColumns) -> DetectionLimit | None:
    """Return the limit of one effect, None where it changes no parameter visibly."""
    data = rows.train_data
    added = rows.adds(what)
    scale = np.linalg.norm(fitted.columns, axis=0)
    scale[scale == 0] = 1.0
    taken = np.linalg.lstsq(fitted.columns / scale, added, rcond=TRACE.rank_limit)[0] / scale
    shown = added - fitted.columns @ taken
    energy = float(shown @ shown)
    if not energy > 0.0:
        return None
    seen = abs(float(shown @ fitted.residual))
    times = (seen + TRACE.normal_quantile * energy**0.5) / energy
    shapes = {k: v for u in data.terms for k, v in shape_values(data.rig, u).items()}
    beta = {**data.beta, **shapes}
    moved = {n: beta.get(n, 0.0) + times * d for n, d in zip(fitted.names, taken, strict=True)}
    before, after = (
        {**shapes, **parameter_values(data.rig, data.terms, b), **s}
        for b, s in (
            (beta, shapes),
            (moved, {n: v for n, v in moved.items() if n in shapes}),
        )
    )
    shifts = {
        name: abs(after[name] / before[name] - 1.0)
        for name, width in fitted.half.items()
        if before.get(name) and abs(after[name] - before[name]) > width
    }
    most = max(shifts, key=lambda name: shifts[name], default="")
    if not most or shifts[most] < TRACE.visible_shift:
        return None
    (used,) = what.effects
    term, (quantity, size, unit) = used.term, _size(data, used, what, times)
    place = str(getattr(term, "place", term.where))
    return DetectionLimit(term.name, place, term.where, quantity, size, unit, most, shifts[most])


def _size(
    data: RegressionData, used: Used, what: Explanation, times: float
) -> tuple[str, float, str]:
    """Return name, value and unit of the number that says how large an effect is."""
    for c in used.term.coefficients(data.rig):
        if what.beta.get(c.parameter):
            return c.parameter, abs(what.beta[c.parameter]) * times, c.unit
    shapes = shapes_of(data.rig, used)
    k = next(k for k, s in enumerate(shapes) if used.shape[k] != (s.neutral or 0.0))
    neutral = shapes[k].neutral or 0.0
    return shapes[k].parameter, abs(used.shape[k] - neutral) * times, shapes[k].unit


def in_words(limits: Sequence[DetectionLimit]) -> list[str]:
    """Return a sentence for each of the largest limits."""
    return [
        f"not excluded by these records: {d.name} at {place_in_words(d.at)} up to {d.quantity} = "
        f"{f'{plain(d.size, 2)} {typeset(d.unit)}'.strip()}, which would change {d.parameter} by "
        f"{plain(100 * d.shift, 2)} % without a residual above the noise"
        for d in limits[: TRACE.most_limits]
    ]
