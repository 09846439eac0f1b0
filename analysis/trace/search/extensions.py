"""Extension of a set of effects by one more.

Candidates are ranked by columns of first order on data that have the set among their terms. Those
that such columns hide are tried beside them: other parts of a law, and details of a sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in, effects_among
from analysis.trace.data.regression_data import RegressionData, VariantColumns, variant_columns
from analysis.trace.search import linear_fit
from analysis.trace.search.exact_fit import jacobian, rebased
from analysis.trace.search.hypothesis import (
    BENCH,
    Hypothesis,
    Key,
    keys_of,
    law_of,
    may_grow,
    of_one_law,
    spoils_equation,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.refinement import at_best_size
from analysis.trace.settings import SEARCH

Array = NDArray[np.float64]


def extensions(
    hypotheses: HypothesisSet, current: Hypothesis, equations: Collection[str] = (),
    free: bool = False, rival: Hypothesis | None = None,
) -> list[Hypothesis]:  # fmt: skip
    """Return the best sets with one more effect, found on data with the set in their model.

    `equations` restricts the search to their rows, `free` to free mechanisms. `rival` is the set
    that they may replace (`HypothesisSet.refined`).
    """

    def fit(sets: HypothesisSet, effects: tuple[Used, ...]) -> Hypothesis:
        return extended(sets, current, effects, rival)

    larger = hypotheses.each(fit, _starts_by_columns(hypotheses, current, equations, free))
    if free:
        return larger
    hidden: dict[frozenset[Key], tuple[Used, ...]] = {}
    for effects in _starts_that_columns_hide(hypotheses, current, larger, equations):
        hidden.setdefault(keys_of(effects), effects)
    return larger + hypotheses.each(fit, hidden.values())


def _starts_by_columns(
    hypotheses: HypothesisSet, current: Hypothesis, equations: Collection[str], free: bool
) -> list[tuple[Used, ...]]:
    """Return the set with each of the candidates that leave least by their columns beside it.

    A free mechanism and a name of it are not combined at one place: one would fit the other's form
    error.
    """
    data, laws = rebased(hypotheses.train_data, current.fit), current.laws
    curves = {law_of(e) for e in effects_among(current.effects) if e.free}

    def possible(effect: Effect) -> bool:
        return (
            effect.key not in current.keys
            and (effect.free or not free)
            and law_of(effect) not in (laws if effect.free else curves)
            and may_act(hypotheses, effect, current, equations)
        )

    points = hypotheses.variants_of(data, current.fit.residual)
    columns = variant_columns(
        data,
        [used for used in points if possible(effect_in(used))],
        equations=equations,
        pool=hypotheses.pool,
    )
    mask = data.in_equations(equations or data.row_counts).astype(np.float64)
    return best_additions(hypotheses, data, current, columns, mask)[: SEARCH.refined_extensions]


def _starts_that_columns_hide(
    hypotheses: HypothesisSet, current: Hypothesis, larger: Sequence[Hypothesis],
    equations: Collection[str],
) -> Iterator[tuple[Used, ...]]:  # fmt: skip
    """Yield sets whose new effect first-order columns do not show, none of them among `larger`.

    Alone, a sensor's gain is fitted far from its size beside an offset, and the reverse. Beside
    effects that are physically impossible alone, the other parts of their laws are tried.
    """
    members = effects_among(current.effects)
    for effect in hypotheses.effects if may_grow(current.effects) else ():
        goes_with = any(map(effect.is_alternative_to_detail, members))
        if goes_with and not any(effect.key in o.keys for o in (current, *larger)):
            yield (*current.effects, at_start(hypotheses.train_data.rig, effect))
    for hypothesis in (current, *filter(hypotheses.physical_problem, larger)):
        yield from with_parts_beside(hypotheses, hypothesis, equations)


def best_additions(
    hypotheses: HypothesisSet, data: RegressionData, current: Hypothesis,
    columns: Sequence[VariantColumns], mask: Array | None = None,
) -> list[tuple[Used, ...]]:  # fmt: skip
    """Return the set with each candidate, in the order of what they leave by their columns.

    `data` have the set in their model; `mask` (M,) is 0 for rows that do not count.
    """
    candidates, r = candidates_beside(hypotheses, data, current, columns, mask)
    starts: dict[Key, tuple[Used, ...]] = {}
    for trial in linear_fit.sets_with_one_more(candidates, (), r):
        used = candidates.entries[trial.members[0]].used
        starts.setdefault(used.term.key, (*current.effects, used))
    return list(starts.values())


def candidates_beside(
    hypotheses: HypothesisSet, data: RegressionData, current: Hypothesis,
    columns: Sequence[VariantColumns], mask: Array | None = None,
) -> tuple[linear_fit.CandidateColumns, Array]:  # fmt: skip
    """Return candidates and residual (M,), orthogonal to what the set can remove itself.

    The set's shapes are fitted again beside a new effect: energy that they can remove is no
    gain of that effect.
    """
    moves = (jacobian(hypotheses.train_data, current.fit, used)[1] for used in current.effects)
    absorbing = replace(data, base=np.hstack((data.base, *moves)))
    candidates = hypotheses.candidate_columns(absorbing, columns, mask)
    r = current.fit.residual if mask is None else current.fit.residual * mask
    return candidates, r - candidates.basis @ (candidates.basis.T @ r)


def with_parts_beside(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, equations: Collection[str] = ()
) -> Iterator[tuple[Used, ...]]:
    """Yield the sets with another part of an effect's law beside it, both at their start.

    Alone, a breakaway is fitted far from its size beside Coulomb friction: first-order columns
    do not show the pair, and each alone may be physically impossible.
    """
    rig = hypotheses.train_data.rig
    if not may_grow(hypothesis.effects):
        return
    for used in hypothesis.effects:
        member = effect_in(used)
        for effect in hypotheses.effects:
            part = of_one_law(effect, member) and (effect.beside or member.beside)
            acts = may_act(hypotheses, effect, hypothesis, equations)
            if part and acts and effect.key not in hypothesis.keys:
                yield (*hypothesis.without(used), at_start(rig, member), at_start(rig, effect))


def extended(
    hypotheses: HypothesisSet, current: Hypothesis, effects: Sequence[Used],
    rival: Hypothesis | None = None,
) -> Hypothesis:  # fmt: skip
    """Return the exact fit of a set that extends `current`, with its shapes and forms.

    A new effect starts at the size that leaves least. Where an equation keeps more than under
    `current`, an earlier fit of the same set ended in a local minimum and is repeated.
    """
    added = [u for u in effects if u.term.key not in current.keys]
    others = [u for u in effects if u not in added]
    effects = [*others, *(at_best_size(hypotheses.train_data, u, others) for u in added)]
    known = keys_of(effects) in hypotheses.fitted
    fitted = hypotheses.refined(effects, rival, others)
    if known and spoils_equation(fitted, current, hypotheses.noise_band):
        return hypotheses.refined_anew(effects, rival)
    return fitted


def may_act(
    hypotheses: HypothesisSet, effect: Effect, current: Hypothesis, equations: Collection[str]
) -> bool:
    """Return whether a candidate may have columns in some of `equations`, true without any.

    They are those in which it has columns under the baseline. Beside an effect of the bench,
    which couples the joints' flows, it may act in any.
    """
    coupled = any(u.term.where.startswith(BENCH) for u in current.effects)
    if not equations or coupled or effect.key not in hypotheses.acting_equations:
        return True
    return not hypotheses.acting_equations[effect.key].isdisjoint(equations)


def extended_in(
    hypotheses: HypothesisSet, current: Hypothesis, equations: Collection[str],
    rival: Hypothesis | None = None,
) -> Hypothesis | None:  # fmt: skip
    """Return the set with the effect that removes most from `equations`, None if none does.

    It may replace `rival`, if that is given (`HypothesisSet.refined`). Other equations do not
    count: the form error of a large effect there would hide a small one here. A set that leaves as
    little in `equations` with fewer effects is returned instead.
    """
    if not may_grow(current.effects):
        return None

    def remaining(hypothesis: Hypothesis) -> float:
        return sum(hypothesis.excess_energy[e] for e in equations)

    def removes_enough(hypothesis: Hypothesis) -> bool:
        drop = {e: current.excess_energy[e] - hypothesis.excess_energy[e] for e in equations}
        acting = [e for e, v in drop.items() if v >= SEARCH.acting_share * max(drop.values())]
        start = sum(max(0.0, current.excess_energy[e]) for e in acting)
        least = SEARCH.number_price * (hypothesis.size[1] - current.size[1])
        return sum(drop[e] for e in acting) > max(least, SEARCH.add_share * start)

    tried = extensions(hypotheses, current, equations, rival=rival)
    tried += hypotheses.simpler_sets(tried)
    tried += _smaller_sets(hypotheses, current, tried)
    useful = [o for o in tried if removes_enough(o) and not hypotheses.physical_problem(o)]
    if not useful:
        return None
    least = min(map(remaining, useful))
    slack = max((SEARCH.simpler_ratio - 1.0) * max(0.0, least), SEARCH.number_price)
    similar = [o for o in useful if remaining(o) <= least + slack]
    return hypotheses.in_best_forms(min(similar, key=lambda o: (sum(o.size), remaining(o))))


def _smaller_sets(
    hypotheses: HypothesisSet, current: Hypothesis, tried: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Return the fitted sets of fewer effects than `tried`, none larger, none spoiling one."""
    least = min(((o.size[0], sum(o.size)) for o in tried), default=(0, 0))
    return [
        o
        for o in hypotheses.fitted.values()
        if 0 < o.size[0] < least[0] and sum(o.size) <= least[1]
        and not spoils_equation(o, current, hypotheses.noise_band)
    ]  # fmt: skip
