"""The curve of a free mechanism over its own variable, with the band of its errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values, shapes_of
from analysis.identify.settings import IDENTIFY
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.least_squares import column_scale
from analysis.regression.rows import Rows
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.result import Curve
from analysis.trace.search.exact_fit import ExactFit, tangent
from analysis.trace.settings import TRACE
from rig.model.rig import Rig
from rig.model.units import plain

Array = NDArray[np.float64]


def curves_of(data: RegressionData, model: ExactFit, used: Used) -> tuple[Curve, ...]:
    """Return the lines of an effect's curve with 95 % bands from noise, none without a curve."""
    effect = used.term
    lines = effect.branches(data.rig, used.shape) if isinstance(effect, Effect) else ()
    if not lines:
        return ()
    names, covariance = noise_covariance(data, model)
    values = {**model.beta, **shape_values(data.rig, used)}
    out = []
    for line in lines:
        shared = [n for n in line.weights if n in names]
        numbers = [names.index(n) for n in shared]
        W = np.column_stack([line.weights[n] for n in shared])
        y = W @ np.array([values[n] for n in shared])
        variance = W @ covariance[np.ix_(numbers, numbers)] * W
        half = IDENTIFY.normal_quantile * np.sqrt(np.maximum(variance.sum(axis=1), 0.0))
        band = (y - half, y + half)
        if line.reciprocal:
            y, band = 1.0 / y, (1.0 / band[1], 1.0 / band[0])
        out.append(Curve(line.label, line.x, y, *band, line.unit_x, line.unit_y))
    return tuple(out)


class CurveRange:
    """Rows of data within the outermost knots of all free curves of a model.

    Beyond them a curve is extrapolated by a straight line, which is no evidence on the mechanism.
    Of equations `beyond` the range fewer than `TRACE.least_rows` lie within it: these cannot judge,
    and the others would judge an extrapolation.
    """

    def __init__(self, data: RegressionData, model: ExactFit) -> None:
        self.data = data
        self.curves = tuple(u for u in model.terms if isinstance(u.term, Effect) and u.term.free)
        self._inside = np.ones(len(data.base), dtype=bool)
        self._kept: Counter[str] = Counter()
        for s in data.segments:
            inside = within_knots(data.rig, self.curves, *data.source(s))
            self._inside[s.where] = inside
            self._kept[s.equation] += int(np.count_nonzero(inside))
        rows = data.row_counts
        self.beyond = {e for e, n in rows.items() if self._kept[e] < min(n, TRACE.least_rows)}

    @property
    def rows(self) -> RegressionData:
        """The rows within the range, of equations `beyond` it all rows."""
        inside = self._inside | self.data.in_equations(self.beyond)
        return self.data if inside.all() else self.data.at(inside)

    @property
    def limits(self) -> Mapping[str, tuple[Used, ...]]:
        """By equation the free curves beyond which rows are left out of its error.

        An equation without any row within them has the error of the extrapolated curves.
        """
        return {e: self.curves for e in self.data.row_counts if self._kept[e]}

    @property
    def notes(self) -> list[str]:
        """A note for every equation of which judging rows lie beyond the range."""
        left_out = "they cannot judge it, and are left out of the errors"
        too_few = "too few remain within it to judge it, so that only the rows that choose do"
        return [
            f"{e}: {plain(100 * (rows - self._kept[e]) / rows, 2)} % of the judging rows lie "
            f"beyond the range of the fitted curve: {too_few if e in self.beyond else left_out}; "
            "train with motions at least as large"
            for e, rows in self.data.row_counts.items()
            if self._kept[e] < rows
        ]


def within_knots(
    rig: Rig, curves: Sequence[Used], conditioned: ConditionedRecord, rows: Rows
) -> NDArray[np.bool_]:
    """Return a mask (m,) of a record's rows between the outermost knots of every curve."""
    inside = np.ones(len(rows.time), dtype=bool)
    for used in curves:
        values = effect_in(used).abscissa(rig, conditioned.signals).get(rows.equation)
        if values is None:
            continue
        named = zip(shapes_of(rig, used), used.shape, strict=True)
        knots = [value for shape, value in named if "_knot_" in shape.parameter]
        margin = TRACE.knot_margin * (knots[-1] - knots[0])
        x = values[conditioned.samples_at(rows.time)]
        # A curve whose knots begin at zero is over the absolute value.
        x = np.abs(x) if knots[0] == 0.0 else x
        inside &= (x >= knots[0] - margin) & (x <= knots[-1] + margin)
    return inside


def noise_covariance(data: RegressionData, model: ExactFit) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance from noise (p, p) of a model's coefficients and shapes."""
    names, X = tangent(data, model)
    scale = column_scale(X)
    inverse = np.linalg.pinv((X / scale).T @ (X / scale), rcond=1e-12, hermitian=True)
    return names, inverse / np.outer(scale, scale)
