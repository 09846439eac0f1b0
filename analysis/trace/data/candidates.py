"""Candidates: every effect of the catalogue at every place, with a grid of starting shapes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from analysis.effects.base import Effect, Evidence, Shape, shapes_of
from analysis.terms import known
from analysis.terms.base import Used
from analysis.trace.settings import DATA
from rig.model.rig import Rig


def effect_in(used: Used) -> Effect:
    """Return a used term's effect; the term must be an effect."""
    assert isinstance(used.term, Effect)
    return used.term


def effects_among(terms: Iterable[Used]) -> list[Effect]:
    """Return the effects among a model's terms."""
    return [used.term for used in terms if isinstance(used.term, Effect)]


def at_start(rig: Rig, effect: Effect) -> Used:
    """Return an effect at the shape from which a search begins."""
    return Used(effect, effect.shape_of(rig, ()))


def catalogue(rig: Rig, names: Sequence[str] | None = None) -> list[Effect]:
    """Return every named effect of the catalogue, or those `names`, at every place it can be at."""
    return [
        kind(where)
        for name, kind in sorted(known().items())
        if issubclass(kind, Effect) and (not kind.free if names is None else name in names)
        for where in kind.places(rig)
    ]


def free_mechanisms(rig: Rig) -> list[Effect]:
    """Return every mechanism whose curve the data give, at every place it can be at."""
    kinds = [kind for _, kind in sorted(known().items()) if issubclass(kind, Effect) and kind.free]
    return [kind(where) for kind in kinds for where in kind.places(rig)]


def shape_grid(
    effect: Effect, rig: Rig, evidence: Evidence | None = None
) -> list[tuple[float, ...]]:
    """Return the shape grid of an effect, thinned where it has too many points.

    An effect whose points depend on the data has none without `evidence`.
    """
    if effect.by_data:
        return list(effect.points(rig, evidence)) if evidence is not None else []
    axes = [shape.grid for shape in effect.shapes(rig) if not shape.detail]
    grid = list(itertools.product(*axes))
    if len(grid) > DATA.grid_points:
        per_axis = max(2, int(DATA.grid_points ** (1 / len(axes))))
        thinned = [
            tuple(
                axis[i]
                for i in np.unique(np.linspace(0, len(axis) - 1, per_axis).round().astype(int))
            )
            for axis in axes
        ]
        grid = list(itertools.product(*thinned))
    return [*grid, *effect.further_points(rig)]


def variants(rig: Rig, effects: Sequence[Effect], evidence: Evidence | None = None) -> list[Used]:
    """Return every candidate at every point of its grid."""
    return [
        Used(effect, shape) for effect in effects for shape in shape_grid(effect, rig, evidence)
    ]


def complexity(rig: Rig, used: Sequence[Used]) -> tuple[int, int]:
    """Return the number of effects and of their free numbers, details of forms not counted."""
    numbers = sum(
        len(u.term.coefficients(rig))
        + sum(not (shape.detail or shape.fixed) for shape in shapes_of(rig, u))
        for u in used
    )
    return len(used), numbers


def details(rig: Rig, used: Sequence[Used]) -> int:
    """Return the number of fitted details that the forms of effects have."""
    return sum(not shape.fixed for shape in _present_details(rig, used))


def fixed_details(rig: Rig, used: Sequence[Used]) -> int:
    """Return the number of details of fixed value that the forms of effects have."""
    return sum(shape.fixed for shape in _present_details(rig, used))


def _present_details(rig: Rig, used: Sequence[Used]) -> Iterator[Shape]:
    for u in used:
        for shape, value in zip(shapes_of(rig, u), u.shape, strict=True):
            if shape.detail and shape.is_present(value):
                yield shape
