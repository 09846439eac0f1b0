"""Exchange of the effects of a set for other candidates."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.terms.base import Used
from analysis.trace.data.candidates import complexity
from analysis.trace.search.exact_fit import rebased
from analysis.trace.search.hypothesis import Hypothesis, keys_of, may_grow
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH


def exchanged(hypotheses: HypothesisSet, current: Hypothesis) -> Hypothesis:
    """Return the set, or a better one with an effect exchanged for another one or for two.

    An effect that was chosen before the last one was added may be worse beside it than one that it
    hid, and one effect may have been chosen in place of two (`linear_fit.best_pairs`).
    """
    tried = {current.keys}
    while current.effects:
        sets = _with_another(hypotheses, current)
        for used in current.effects:
            sets += _with_two_for_one(hypotheses, current, used)
        pruned = hypotheses.prune(hypotheses.best([current, *sets]))
        other = hypotheses.best([current, pruned])  # one that lost an effect again may be worse
        if other.keys in tried:
            break
        current = other
        tried.add(current.keys)
    return hypotheses.fitted.get(current.keys, current)  # a later start may have better shapes


def _with_two_for_one(
    hypotheses: HypothesisSet, current: Hypothesis, used: Used
) -> list[Hypothesis]:
    """Return the sets with two other effects in the place of one, the best by their columns.

    Columns under the baseline choose the candidates: to compute them anew for each set takes long.
    """
    others = current.without(used)
    if not may_grow(others, by=2):
        return []
    taken = keys_of(others)
    columns = [c for c in hypotheses.columns if c.used.term.key not in taken]
    smaller = hypotheses.refined(others)
    data = rebased(hypotheses.train_data, smaller.fit)
    pairs = hypotheses.pairs_like(data, smaller, columns, used.term.key)
    return [
        hypotheses.refined(effects, current)
        for effects in pairs[: SEARCH.replacements]
        if _price(hypotheses, effects) <= sum(current.size) * SEARCH.number_price + current.total
    ]


def _price(hypotheses: HypothesisSet, effects: Sequence[Used]) -> float:
    """Return the price of a set's effects and free numbers, as an energy."""
    return SEARCH.number_price * sum(complexity(hypotheses.train_data.rig, effects))


def _with_another(hypotheses: HypothesisSet, current: Hypothesis) -> list[Hypothesis]:
    """Return the sets with one of the best other candidates in the place of an effect.

    Columns under the baseline choose the candidates: to compute them anew for each set takes long.
    A single effect has been compared with the others already.
    """
    if len(current.effects) < 2:
        return []
    columns = [c for c in hypotheses.columns if c.used.term.key not in current.keys]
    sets = []
    for used in current.effects:
        smaller = hypotheses.refined_anew(current.without(used))
        data = rebased(hypotheses.train_data, smaller.fit)
        starts = hypotheses.best_additions(data, smaller, columns)[: SEARCH.replacements]
        sets += [hypotheses.extended(smaller, effects) for effects in starts]
    return sets
