"""Search by exact columns, where the search by first-order columns leaves too much.

First-order columns do not hold for large sizes: a sensor's cross-talk of a quarter, a pressure in
the return line of a fifth of the supply's.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence

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
        tried = [
            hypotheses.refined_below(energy, effects, current)
            for energy, effects in _best_trials(hypotheses, current, above)
        ]
        pruned = hypotheses.prune(hypotheses.best([current, *tried]))
        better = exchanged(hypotheses, pruned)
        to_noise = hypotheses.within_noise(better)
        tolerated = hypotheses.within_form_tolerance(current) and not to_noise
        least = SEARCH.far_log_gain if tolerated else SEARCH.least_log_gain
        if log_energy_ratio(current, better, hypotheses.noise_band) < least:
            break
        current = better
    return current


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
    best_trial: dict[Key, _Trial] = {}
    for used in hypotheses.variants_of(data, current.fit.residual):
        effect = effect_in(used)
        may_join = effect.key not in current.keys and not effect.free
        if may_join and may_act(hypotheses, effect, current, equations):
            effects = (*start, used)
            energy = fit_coefficients(data, (*hypotheses.base, *effects)).energy
            if energy < best_trial.get(effect.key, (float("inf"), ()))[0]:
                best_trial[effect.key] = energy, effects
    ordered = sorted(best_trial.values(), key=lambda trial: trial[0])
    possible = (
        trial for trial in ordered
        if not hypotheses.physical_problem(hypotheses.at_given_shapes(trial[1]))
    )  # fmt: skip
    return list(itertools.islice(possible, SEARCH.exact_trials))
