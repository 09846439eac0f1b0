"""The forward search: the best single effects and pairs by their columns, then extensions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.terms.base import Used
from analysis.trace.search import linear_fit
from analysis.trace.search.extensions import extensions
from analysis.trace.search.hypothesis import Hypothesis, Key, log_energy_ratio, may_grow
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH

Array = NDArray[np.float64]


def search(hypotheses: HypothesisSet) -> Hypothesis:
    """Search single effects, pairs and extensions, and return the best set."""
    hypotheses.compute_columns()
    candidates, r = hypotheses.candidates, hypotheses.train_data.mean_residual
    r = r - candidates.basis @ (candidates.basis.T @ r)
    result = _searched(hypotheses, candidates, r)
    return hypotheses.fitted.get(result.keys, result)  # a later start may have found better shapes


def _searched(
    hypotheses: HypothesisSet, candidates: linear_fit.CandidateColumns, r: Array
) -> Hypothesis:
    """Return the best set for the baseline's residual r (M,), orthogonal to its columns."""
    band = hypotheses.noise_band
    singles = hypotheses.each(HypothesisSet.refined, _best_singles(hypotheses, candidates, r))
    current = hypotheses.prune(hypotheses.best([hypotheses.empty, *singles]))
    if hypotheses.within_noise(current):
        return current
    trials = [
        [candidates.entries[m].used for m in pair.members]
        for pair in (
            *linear_fit.best_pairs(candidates, r), *linear_fit.pairs_of_chambers(candidates, r)
        )
    ]  # fmt: skip
    pairs = [hypotheses.refined(trial, current) for trial in trials[:1]]
    rival = min((current, *pairs), key=lambda o: o.total)
    pairs += hypotheses.each(partial(HypothesisSet.refined, rival=rival), trials[1:])
    if hypotheses.within_form_tolerance(current):
        others = [o for o in pairs if not current.keys & o.keys]
        far = [o for o in others if log_energy_ratio(o, current, band) < -SEARCH.far_log_gain]
        best = hypotheses.prune(hypotheses.best([current, *far]))
        return completed_to_noise(hypotheses, best, pairs)
    best = hypotheses.prune(hypotheses.best([hypotheses.empty, *singles, *pairs]))
    current = _grown(hypotheses, best)
    if hypotheses.within_form_tolerance(current):
        return current
    return _grown(hypotheses, _begun_with_another(hypotheses, current, singles))


def _begun_with_another(
    hypotheses: HypothesisSet, current: Hypothesis, singles: Sequence[Hypothesis]
) -> Hypothesis:
    """Return the set, or a better pair that begins with a single effect which it lacks.

    A cross-talk may leave less than the true gain while a second effect is missing, and no
    further effect beside the cross-talk explains what it leaves.
    """
    others = [
        o for o in singles if not o.keys & current.keys and not hypotheses.physical_problem(o)
    ]
    nearest = sorted(others, key=lambda o: o.total)[: SEARCH.other_starts]
    pairs = [pair for single in nearest for pair in extensions(hypotheses, single, rival=current)]
    return hypotheses.prune(hypotheses.best([current, *pairs]))


def _grown(hypotheses: HypothesisSet, current: Hypothesis) -> Hypothesis:
    """Return the set with further effects, while each leaves enough less and more than noise.

    A set within the tolerance for its forms grows only to one that leaves noise alone.
    """
    band = hypotheses.noise_band
    while not hypotheses.within_noise(current) and may_grow(current.effects):
        grown = hypotheses.prune(hypotheses.best([current, *extensions(hypotheses, current)]))
        if (
            grown.keys == current.keys
            or log_energy_ratio(current, grown, band) < SEARCH.least_log_gain
        ):
            break
        current = grown
        if hypotheses.within_form_tolerance(current):
            return completed_to_noise(hypotheses, current)
    return current


def completed_to_noise(
    hypotheses: HypothesisSet, current: Hypothesis, others: Sequence[Hypothesis] = ()
) -> Hypothesis:
    """Return a set within form error, or a larger or another one if that leaves noise alone.

    An effect that leaves less, but more than noise, would only fit the form error.
    """
    if hypotheses.within_noise(current) or not may_grow(current.effects):
        return current
    larger = [*extensions(hypotheses, current), *others]
    best = hypotheses.best([o for o in larger if hypotheses.within_noise(o)])
    return best if best.effects and hypotheses.prune(best).keys == best.keys else current


def _best_singles(
    hypotheses: HypothesisSet, candidates: linear_fit.CandidateColumns, r: Array
) -> list[tuple[Used, ...]]:
    """Return the single effects that remove most of r (M,), each at its best point."""
    g = linear_fit.gains(
        candidates.K, candidates.columns.T @ r, candidates.groups, candidates.visibility_limit
    )
    out: dict[Key, tuple[Used, ...]] = {}
    least = SEARCH.near_gain * float(np.max(g, initial=0.0))
    for i in map(int, np.argsort(-g)):
        used = candidates.entries[i].used
        if (
            (g[i] > least or (g[i] > 0 and len(out) < 3))
            and used.term.key not in out
            and len(out) < SEARCH.refined_singles
        ):
            out[used.term.key] = (used,)
    return list(out.values())
