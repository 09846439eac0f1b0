"""Exchange of the effects of a set for other candidates."""

from __future__ import annotations

from analysis.trace.search.confounders import composites
from analysis.trace.search.exact_fit import rebased
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH


def exchanged(hypotheses: HypothesisSet, current: Hypothesis) -> Hypothesis:
    """Return the set, or a better one with an effect exchanged for another one or for two.

    An effect that was chosen before the last one was added may be worse beside it than one that it
    hid, and one effect may have been chosen in place of two (`confounders.composites`).
    """
    tried = {current.keys}
    while current.effects:
        sets = [*_with_two_for_one(hypotheses, current), *_with_another(hypotheses, current)]
        pruned = hypotheses.prune(hypotheses.best([current, *sets]))
        other = hypotheses.best([current, pruned])  # one that lost an effect again may be worse
        if other.keys in tried:
            break
        current = other
        tried.add(current.keys)
    return hypotheses.fitted.get(current.keys, current)  # a later start may have better shapes


def _with_two_for_one(hypotheses: HypothesisSet, current: Hypothesis) -> list[Hypothesis]:
    """Return the sets with two effects in the place of one."""
    data, candidates = hypotheses.train_data, hypotheses.effects
    return [
        hypotheses.refined(effects, current)
        for used in current.effects
        for effects in composites(data, candidates, current, used)
    ]


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
