"""Exchange of the effects of a set for other candidates."""

from __future__ import annotations

from functools import partial

from analysis.terms.base import Used
from analysis.trace.data.candidates import complexity
from analysis.trace.search import linear_fit
from analysis.trace.search.exact_fit import rebased
from analysis.trace.search.extensions import best_additions, candidates_beside, extended
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
        pairs = [p for u in current.effects for p in _with_two_for_one(hypotheses, current, u)]
        fit = partial(HypothesisSet.refined, rival=current)
        sets = [*_with_another(hypotheses, current), *hypotheses.each(fit, pairs)]
        pruned = hypotheses.prune(hypotheses.best([current, *sets]))
        other = hypotheses.best([current, pruned])  # one that lost an effect again may be worse
        if other.keys in tried:
            break
        current = other
        tried.add(current.keys)
    return hypotheses.fitted.get(current.keys, current)  # a later start may have better shapes


def _with_two_for_one(
    hypotheses: HypothesisSet, current: Hypothesis, used: Used
) -> list[tuple[Used, ...]]:
    """Return the sets to fit with two other effects in the place of one, the best by their columns.

    The pairs and the effect are compared by their columns of first order, under the baseline: to
    compute them anew for each set takes long. Pairs that leave more than the effect by more than
    the noise's band, or whose numbers cost more than all that is left, are left out.
    """
    others, key = current.without(used), used.term.key
    if not may_grow(others, by=2):
        return []
    taken = keys_of(others)
    columns = [c for c in hypotheses.columns if c.used.term.key not in taken]
    smaller = hypotheses.refined(others)
    data = rebased(hypotheses.train_data, smaller.fit)
    candidates, r = candidates_beside(hypotheses, data, smaller, columns)
    alone = [m for m, e in enumerate(candidates.entries) if e.used.term.key == key]
    least = min((linear_fit.fit_members(candidates, [m], r).total for m in alone), default=0.0)
    limit = least + sum(hypotheses.noise_band.values())
    pairs = [
        *linear_fit.best_pairs(candidates, r, [key])[: SEARCH.replacements],
        *linear_fit.pairs_of_chambers(candidates, r, [key])[:1],
    ]
    sets = [
        (*smaller.effects, *(candidates.entries[m].used for m in pair.members))
        for pair in pairs if pair.total < limit
    ]  # fmt: skip
    affordable = current.total + SEARCH.number_price * sum(current.size)
    return [
        effects
        for effects in sets
        if SEARCH.number_price * sum(complexity(data.rig, effects)) <= affordable
    ]


def _with_another(hypotheses: HypothesisSet, current: Hypothesis) -> list[Hypothesis]:
    """Return the sets with one of the best other candidates in the place of an effect.

    Columns under the baseline choose the candidates: to compute them anew for each set takes long.
    Beside them the best candidate is tried that was fitted alone and that they do not show: columns
    of first order do not reach an inclination of 0.3 rad. A single effect has been compared with
    the others already.
    """
    if len(current.effects) < 2:
        return []
    columns = [c for c in hypotheses.columns if c.used.term.key not in current.keys]
    alone = [o for o in hypotheses.fitted.values() if o.size[0] == 1 and not o.keys & current.keys]
    alone.sort(key=lambda o: o.total)
    starts: list[tuple[Hypothesis, tuple[Used, ...]]] = []
    both: list[tuple[Used, ...]] = []
    fit_anew = partial(HypothesisSet.refined_anew, rival=current)
    for smaller in hypotheses.each(fit_anew, map(current.without, current.effects)):
        data = rebased(hypotheses.train_data, smaller.fit)
        larger = best_additions(hypotheses, data, smaller, columns)
        starts += [(smaller, effects) for effects in larger[: SEARCH.replacements]]
        shown = {effects[-1].term.key for effects in larger}
        hidden = [o for o in alone if not o.keys & shown and not hypotheses.physical_problem(o)]
        both += [(*smaller.effects, *single.effects) for single in hidden[:1]]
    return [
        *hypotheses.each(lambda sets, start: extended(sets, *start, current), starts),
        *hypotheses.each(lambda sets, effects: sets.refined(effects, current, effects), both),
    ]
