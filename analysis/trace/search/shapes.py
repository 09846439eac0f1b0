"""Shapes of effects that the user names without shapes: fitted to the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.effects.base import Effect, Shape, open_shapes, shapes_of
from analysis.identify import checks as ck
from analysis.terms.base import Used
from analysis.trace.data.candidates import shape_grid
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import evidence, regression_data
from analysis.trace.data.temperature_nuisance import temperature_terms
from analysis.trace.search.refinement import fit_coefficients, refine
from analysis.trace.settings import SEARCH
from rig.model.records import Run
from rig.model.rig import Rig


def with_shapes(runs: Sequence[Run], terms: Sequence[Used]) -> tuple[Used, ...]:
    """Return the terms of a model with open shapes fitted to the runs' rows.

    By variable projection: effects are added one after another, each from the points of its shape
    grid that leave least. Given shapes are kept. Raises InputError for unusable records.
    """
    rig = ck.common_rig(runs)
    wanted = [u for u in terms if open_shapes(rig, u)]
    if not wanted:
        return tuple(terms)
    known = [u for u in terms if u not in wanted]
    data = regression_data(
        rig, (*known, *temperature_terms(known, runs)), conditioned_records(rig, runs)
    )
    refined: tuple[Used, ...] = ()
    seen = evidence(data, data.mean_residual)
    for used in wanted:
        assert isinstance(used.term, Effect)
        looks = shape_grid(used.term, rig, seen)
        trials = [(*data.terms, *refined, Used(used.term, p)) for p in looks]
        # Several starts, since the best point may be one from which no search leads on: a metering
        # edge that no spool reaches has no derivative.
        near = sorted(trials, key=lambda trial: fit_coefficients(data, trial).energy)[
            : SEARCH.shape_starts
        ]
        best = min((refine(data, trial) for trial in near), key=lambda candidate: candidate.energy)
        refined = best.terms[len(data.terms) :]
    shaped = dict(zip(wanted, refined, strict=True))
    return tuple(shaped.get(u, u) for u in terms)


def shapes_in(rig: Rig, terms: Sequence[Used]) -> Mapping[str, tuple[float, Shape]]:
    """Return value and description of every shape that a model has, by its name."""
    return {
        s.parameter: (value, s)
        for u in terms
        for value, s in zip(u.shape, shapes_of(rig, u), strict=True)
    }
