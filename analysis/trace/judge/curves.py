"""The curve of a free mechanism over its own variable, with the band of its errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.result import Curve
from analysis.trace.search.refinement import ExactFit, tangent
from analysis.trace.settings import TRACE

Array = NDArray[np.float64]


def curves_of(data: RegressionData, model: ExactFit, used: Used) -> tuple[Curve, ...]:
    """Return the lines of an effect's curve with their 95 % band from the rows' noise."""
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


def _covariance(data: RegressionData, model: ExactFit) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance of everything free in a model, noise as the floor has it."""
    names, X = tangent(data, model)
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((X / scale).T @ (X / scale), rcond=1e-12, hermitian=True)
    return names, inverse / np.outer(scale, scale)
