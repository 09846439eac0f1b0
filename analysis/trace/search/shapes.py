"""Shapes of effects that somebody names: found on the records, where none are given."""

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
    """Return the terms of a model with the shapes that leave least in the runs' rows.

    By variable projection, one effect after the other joining, each from the points of its grid
    that leave least; shapes that are given stay. Raises InputError for unusable records.
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
        # The least before the search need not be it afterwards: edges that no spool reaches leave
        # little, and nothing to search along.
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
