"""Shapes of effects that the user names without shapes: fitted to the records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from analysis.effects.base import Effect, open_shapes, shapes_of
from analysis.identify import checks as ck
from analysis.simulation.model import Estimate
from analysis.terms.base import Term, Used
from analysis.trace.data.candidates import shape_grid
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, evidence, regression_data
from analysis.trace.data.temperature_nuisance import temperature_terms
from analysis.trace.search.exact_fit import ExactFit, fit_coefficients
from analysis.trace.search.refinement import refine
from analysis.trace.settings import SEARCH
from rig.model.records import Run, with_common_bandwidth
from rig.model.rig import Rig


@dataclass(frozen=True)
class ShapeFit:
    """The terms of a model with shapes found in records, and the fit of them to `data`."""

    terms: tuple[Used, ...]
    data: RegressionData
    fit: ExactFit


def fit_shapes(runs: Sequence[Run], terms: Sequence[Used]) -> ShapeFit | None:
    """Fit the open shapes of a model's terms to the runs' rows; return None where none is open.

    By variable projection: effects are added one after another, each from the points of its shape
    grid that leave least. Then each is searched anew beside the others until none leaves less:
    without its lag, the flow of one joint would spoil b for the lag of another. Given shapes are
    kept. Raises InputError for unusable records.
    """
    runs = with_common_bandwidth(runs)
    rig = ck.common_rig(runs)
    wanted = [u for u in terms if open_shapes(rig, u)]
    if not wanted:
        return None
    known = [u for u in terms if u not in wanted]
    data = regression_data(
        rig, (*known, *temperature_terms(known, runs)), conditioned_records(rig, runs)
    )
    seen = evidence(data, data.mean_residual)

    def searched(effect: Term, others: Sequence[Used], place: int) -> ExactFit:
        assert isinstance(effect, Effect)
        trials = [
            (*data.terms, *others[:place], Used(effect, point), *others[place:])
            for point in shape_grid(effect, rig, seen)
        ]
        # Several starts, since the best point may be one from which no search leads on: a metering
        # edge that no spool reaches has no derivative.
        near = sorted(trials, key=lambda trial: fit_coefficients(data, trial).energy)
        starts = near[: SEARCH.shape_starts]
        return min((refine(data, trial) for trial in starts), key=lambda fit: fit.energy)

    best = fit_coefficients(data, data.terms)
    for k, used in enumerate(wanted):
        best = searched(used.term, best.terms[len(data.terms) :], k)
    improved = len(wanted) > 1
    while improved:
        improved = False
        for k, used in enumerate(wanted):
            own = best.terms[len(data.terms) :]
            again = searched(used.term, (*own[:k], *own[k + 1 :]), k)
            if again.energy < best.energy - SEARCH.number_price:
                best, improved = again, True
    shaped = dict(zip(wanted, best.terms[len(data.terms) :], strict=True))
    return ShapeFit(tuple(shaped.get(u, u) for u in terms), data, best)


def shapes_in(rig: Rig, terms: Sequence[Used]) -> dict[str, Estimate]:
    """Return the value of every shape that a model has, by its name, with no error (NaN)."""
    return {
        s.parameter: Estimate(value, s.unit, math.nan, (math.nan, math.nan))
        for u in terms
        for value, s in zip(u.shape, shapes_of(rig, u), strict=True)
    }
