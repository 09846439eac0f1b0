"""Candidates that are easily confused with an effect, and the sets with them in its place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.hypothesis import Hypothesis, effect_of, is_special_case, may_grow
from analysis.trace.search.refinement import at_best_point

BENCH: Final = "bench"


def act_at_one_joint(effect: Effect, other: Effect) -> bool:
    """Return whether two effects are at the same joint, or one of them is of the bench."""
    places = {" ".join(e.where.split()[:2]) for e in (effect, other)}
    return len({place for place in places if not place.startswith(BENCH)}) <= 1


def _is_confusable(effect: Effect, own: Effect) -> bool:
    """Return whether a candidate is easily confused with an effect of the set.

    It is another name of its mechanism at the same place, or, at its joint or of the bench, the
    same effect on another channel or chamber or one of its confounders.
    """
    same = effect.mechanism == own.mechanism and effect.where == own.where
    alike = effect.name in (own.name, *own.confounders) and act_at_one_joint(effect, own)
    return (same or alike) and not effect.free


def confusable_sets(
    data: RegressionData, candidates: Sequence[Effect], now: Hypothesis
) -> list[tuple[Used, ...]]:
    """Return the sets with one effect exchanged for another candidate or for two."""
    sets = [effects for used in now.effects for effects in composites(data, candidates, now, used)]
    for used in now.effects if len(now.effects) > 1 else ():
        own, others = effect_in(used), now.without(used)
        for effect in candidates:
            if effect.key in now.keys or not _is_confusable(effect, own):
                continue
            fresh = at_best_point(data, effect, others)
            sets.append((*others, fresh))
            if is_special_case(own, effect):
                # Another effect may only have made up for what the simpler law lacks.
                sets += [(*(u for u in others if u is not one), fresh) for one in others]
    return sets


def composites(
    data: RegressionData, candidates: Sequence[Effect], now: Hypothesis, used: Used
) -> list[tuple[Used, ...]]:
    """Return the sets with a simpler name of an effect's law and a confounder in its place.

    The confounder has another mechanism and is at the effect's joint. Friction of one level with
    the offset of a pressure is nearly friction of two levels, but for the flows.
    """
    own = effect_in(used)
    known = now.keys | {u.term.key for u in data.terms}
    others = now.without(used)
    if not may_grow(others, by=2):
        return []
    simpler = [effect_of(n, own.where) for n in own.includes if (n, own.where) not in known]
    confounders = [
        e for e in candidates
        if e.name in own.confounders and act_at_one_joint(e, own)
        and e.mechanism != own.mechanism and e.key not in known
    ]  # fmt: skip
    return [
        (*others, *(at_start(data.rig, e) for e in (simple, other)))
        for simple in simpler for other in confounders
    ]  # fmt: skip
