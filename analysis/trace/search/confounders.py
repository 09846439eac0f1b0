"""Sets in which two effects take the place of one: a special case of it and a confounder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.hypothesis import Hypothesis, effect_of, may_grow

BENCH: Final = "bench"


def act_at_one_joint(effect: Effect, other: Effect) -> bool:
    """Return whether two effects are at the same joint, or one of them is of the bench."""
    places = {" ".join(e.where.split()[:2]) for e in (effect, other)}
    return len({place for place in places if not place.startswith(BENCH)}) <= 1


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
