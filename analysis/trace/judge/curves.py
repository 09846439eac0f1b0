"""The curve of a free mechanism over its own variable, with the band of its errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values, shapes_of
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.result import Curve
from analysis.trace.search.refinement import ExactFit, tangent
from analysis.trace.settings import TRACE
from rig.model.units import plain

Array = NDArray[np.float64]


def curves_of(data: RegressionData, model: ExactFit, used: Used) -> tuple[Curve, ...]:
    """Return the lines of an effect's curve with 95 % bands from noise, none without a curve."""
    effect = used.term
    lines = effect.branches(data.rig, used.shape) if isinstance(effect, Effect) else ()
    if not lines:
        return ()
    names, covariance = _covariance(data, model)
    known = {**model.beta, **shape_values(data.rig, used)}
    out = []
    for line in lines:
        here = [n for n in line.weights if n in names]
        at = [names.index(n) for n in here]
        W = np.column_stack([line.weights[n] for n in here])
        y = W @ np.array([known[n] for n in here])
        spread = W @ covariance[np.ix_(at, at)] * W
        half = TRACE.normal_quantile * np.sqrt(np.maximum(spread.sum(axis=1), 0.0))
        ends = (y - half, y + half)
        if line.reciprocal:
            y, ends = 1.0 / y, (1.0 / ends[1], 1.0 / ends[0])
        out.append(Curve(line.label, line.x, y, *ends, line.unit_x, line.unit_y))
    return tuple(out)


def rows_within_curves(data: RegressionData, model: ExactFit) -> RegressionData:
    """Return the data with only the rows within the outermost knots of a model's free curves.

    Beyond them a curve is extrapolated by a straight line, which is no evidence on the mechanism.
    All rows are returned where a step would keep fewer than `TRACE.least_rows` of an equation.
    """
    inside = _within_knots(data, model)
    return data.at(inside) if not inside.all() and _enough_within(data, inside) else data


def beyond_curve_notes(data: RegressionData, model: ExactFit) -> list[str]:
    """Return a note for every equation of which judging rows lie beyond a model's free curves."""
    inside = _within_knots(data, model)
    beyond = data.at(~inside).row_counts if not inside.all() else {}
    role = "they are in the errors, but speak neither for nor against it"
    if not _enough_within(data, inside):
        role = "a step would keep too few without them, so that they judge the extrapolated curve"
    return [
        f"{e}: {plain(100 * beyond[e] / rows, 2)} % of the judging rows lie beyond the range of "
        f"the fitted curve: {role}; train with motions at least as large"
        for e, rows in data.row_counts.items()
        if e in beyond
    ]


def _within_knots(data: RegressionData, model: ExactFit) -> NDArray[np.bool_]:
    """Return which rows (M,) lie within the outermost knots of all free curves of a model."""
    inside = np.ones(len(data.base), dtype=bool)
    for used in model.terms:
        if isinstance(used.term, Effect) and used.term.free:
            inside &= _between_knots(data, used)
    return inside


def _enough_within(data: RegressionData, inside: NDArray[np.bool_]) -> bool:
    """Return whether each equation of each step keeps `TRACE.least_rows` rows inside (M,)."""
    kept = [inside[s.where] for s in data.segments]
    return all(k.all() or np.count_nonzero(k) >= TRACE.least_rows for k in kept)


def _between_knots(data: RegressionData, used: Used) -> NDArray[np.bool_]:
    """Return in which rows (M,) the variable of a curve lies between its outermost knots."""
    inside, effect = np.ones(len(data.base), dtype=bool), used.term
    assert isinstance(effect, Effect)
    named = zip(shapes_of(data.rig, used), used.shape, strict=True)
    knots = [value for shape, value in named if "_knot_" in shape.parameter]
    margin = TRACE.knot_margin * (knots[-1] - knots[0])
    for segment in data.segments:
        conditioned, rows = data.source(segment)
        values = effect.abscissa(data.rig, conditioned.signals).get(segment.equation)
        if values is not None:
            x = values[conditioned.samples_at(rows.time)]
            # A curve whose knots begin at zero is over the absolute value.
            x = np.abs(x) if knots[0] == 0.0 else x
            inside[segment.where] = (x >= knots[0] - margin) & (x <= knots[-1] + margin)
    return inside


def _covariance(data: RegressionData, model: ExactFit) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance from noise (p, p) of a model's coefficients and shapes."""
    names, X = tangent(data, model)
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((X / scale).T @ (X / scale), rcond=1e-12, hermitian=True)
    return names, inverse / np.outer(scale, scale)
