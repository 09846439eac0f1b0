"""Search by exact columns, where the search by first-order columns leaves too much.

First-order columns do not hold for large sizes: a sensor's cross-talk of a quarter, a pressure in
the return line of a fifth of the supply's.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from functools import partial

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.search.exchanges import exchanged
from analysis.trace.search.extensions import may_act
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    log_energy_ratio,
    may_grow,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH

_Trial = tuple[float, tuple[Used, ...]]  # the energy that a set leaves at a point of a shape grid


def improved_by_exact_trials(hypotheses: HypothesisSet, current: Hypothesis) -> Hypothesis:
    """Return the set, or a better one with a candidate added or in place of an effect.

    Repeated while the set leaves more than noise. A set within the tolerance for its forms is
    replaced only by one that leaves a tenth, or only noise.
    """
    band = hypotheses.noise_band
    while above := {e for e, v in current.excess_energy.items() if v > band[e]}:
        trials = _best_trials(hypotheses, current, above)
        tried = hypotheses.each(partial(_refined_below, current), trials)
        pruned = hypotheses.prune(hypotheses.best([current, *tried]))
        better = exchanged(hypotheses, pruned)
        to_noise = hypotheses.within_noise(better)
        tolerated = hypotheses.within_form_tolerance(current) and not to_noise
        least = SEARCH.far_log_gain if tolerated else SEARCH.least_log_gain
        if log_energy_ratio(current, better, hypotheses.noise_band) < least:
            break
        current = better
    return current


def _refined_below(rival: Hypothesis, hypotheses: HypothesisSet, trial: _Trial) -> Hypothesis:
    return hypotheses.refined_below(*trial, rival)


def _best_trials(
    hypotheses: HypothesisSet, current: Hypothesis, equations: Collection[str]
) -> Iterator[_Trial]:
    """Yield the best sets with a candidate, which acts in `equations`, added or exchanged."""
    starts = [current.without(used) for used in current.effects]
    if may_grow(current.effects):
        starts.append(current.effects)
    for start in starts:
        yield from _best_additions(hypotheses, current, start, equations)


def _best_additions(
    hypotheses: HypothesisSet,
    current: Hypothesis,
    start: Sequence[Used],
    equations: Collection[str],
) -> list[_Trial]:
    """Return the physical sets with one effect beside `start` that leave least on its grid."""
    data = hypotheses.train_data

    def may_join(effect: Effect) -> bool:
        new = effect.key not in current.keys and not effect.free
        return new and may_act(hypotheses, effect, current, equations)

    def energy(used: Used) -> float:
        return fit_coefficients(data, (*hypotheses.base, *start, used)).energy

    points = [
        used
        for used in hypotheses.variants_of(data, current.fit.residual)
        if may_join(effect_in(used))
    ]
    best_trial: dict[Key, _Trial] = {}
    for used, left in zip(points, hypotheses.pool.map(energy, points), strict=True):
        if left < best_trial.get(used.term.key, (float("inf"), ()))[0]:
            best_trial[used.term.key] = left, (*start, used)
    ordered = sorted(best_trial.values(), key=lambda trial: trial[0])
    possible = (
        trial for trial in ordered
        if not hypotheses.physical_problem(hypotheses.at_given_shapes(trial[1]))
    )  # fmt: skip
    return list(itertools.islice(possible, SEARCH.exact_trials))
