"""Shapes from which the search for those of a further effect begins."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.effects.base import Effect, shapes_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, shape_grid
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.settings import SEARCH


def at_best_size(data: RegressionData, used: Used, others: Sequence[Used]) -> Used:
    """Return an effect with its shapes at that share of their size which leaves least.

    `others` are the effects beside it. The shares are `SEARCH.start_shares`.
    """
    shapes = shapes_of(data.rig, used)
    if all(s.neutral is None for s in shapes):
        return used

    def scaled(share: float) -> Used:
        return Used(
            used.term,
            tuple(
                value if s.neutral is None else s.neutral + share * (value - s.neutral)
                for s, value in zip(shapes, used.shape, strict=True)
            ),
        )

    return _least(data, [scaled(share) for share in SEARCH.start_shares], others)


def at_best_point(data: RegressionData, effect: Effect, others: Sequence[Used]) -> Used:
    """Return an effect at the point of its shape grid that leaves least beside others.

    From another point, the search of a shape of either sign may end at the wrong bound.
    """
    shapes = effect.shapes(data.rig)
    if not any(s.neutral is not None and s.low < s.neutral for s in shapes):
        return at_start(data.rig, effect)
    return _least(data, [Used(effect, point) for point in shape_grid(effect, data.rig)], others)


def _least(data: RegressionData, starts: Sequence[Used], others: Sequence[Used]) -> Used:
    """Return the start that leaves least energy in the data's model with the others."""
    return min(starts, key=lambda used: fit_coefficients(data, (*data.terms, *others, used)).energy)
