"""Confounders of an effect, and the sets of effects with one of them in its place."""

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


def _is_confusable(effect: Effect, member: Effect) -> bool:
    """Return whether a candidate is easily confused with the `member` of a set.

    It is another name of the member's mechanism at the same place, or, at the same joint or of the
    bench, the same effect on another channel or chamber or one of its confounders.
    """
    same = effect.mechanism == member.mechanism and effect.where == member.where
    alike = effect.name in (member.name, *member.confounders) and act_at_one_joint(effect, member)
    return (same or alike) and not effect.free


def confusable_sets(
    data: RegressionData, candidates: Sequence[Effect], current: Hypothesis
) -> list[tuple[Used, ...]]:
    """Return the sets with one effect exchanged for another candidate or for two."""
    sets = [s for used in current.effects for s in composites(data, candidates, current, used)]
    for used in current.effects if len(current.effects) > 1 else ():
        member, others = effect_in(used), current.without(used)
        for effect in candidates:
            if effect.key in current.keys or not _is_confusable(effect, member):
                continue
            fresh = at_best_point(data, effect, others)
            sets.append((*others, fresh))
            if is_special_case(member, effect):
                # One of the others may only have compensated what the simpler law lacks.
                sets += [(*(u for u in others if u is not left_out), fresh) for left_out in others]
    return sets


def composites(
    data: RegressionData, candidates: Sequence[Effect], current: Hypothesis, used: Used
) -> list[tuple[Used, ...]]:
    """Return the sets with two effects in place of one: a special case of it and a confounder.

    The confounder has another mechanism and is at the effect's joint. In the torques, friction of
    one level with the offset of a pressure is nearly friction of two levels.
    """
    member = effect_in(used)
    taken = current.keys | {u.term.key for u in data.terms}
    others = current.without(used)
    if not may_grow(others, by=2):
        return []
    where = member.where
    simpler = [effect_of(name, where) for name in member.includes if (name, where) not in taken]
    confounders = [
        e for e in candidates
        if e.name in member.confounders and act_at_one_joint(e, member)
        and e.mechanism != member.mechanism and e.key not in taken
    ]  # fmt: skip
    return [
        (*others, *(at_start(data.rig, e) for e in (simple, other)))
        for simple in simpler for other in confounders
    ]  # fmt: skip
