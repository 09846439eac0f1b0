"""Sets found by exact columns, where the search by first-order columns leaves too much.

A sensor's cross-talk of a quarter or a pressure in the return line of a fifth of the supply's is
far from the sizes for which first-order columns hold.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence

from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    log_energy_ratio,
    may_grow,
    within_band,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH

_Trial = tuple[float, tuple[Used, ...]]  # the energy that a set leaves at a point of a shape grid


def improved_by_exact_trials(hypotheses: HypothesisSet, now: Hypothesis) -> Hypothesis:
    """Return the set, or a better one with an effect added or exchanged, of all candidates.

    It is asked while the set leaves more than noise. A set within the tolerance for its forms is
    left only for one that leaves a tenth, or only noise.
    """
    band = hypotheses.noise_band.by_equation
    while above := {e for e, v in now.excess_energy.items() if v > band[e]}:
        tried = [
            hypotheses.refined_below(energy, effects)
            for energy, effects in _best_trials(hypotheses, now, above)
        ]
        better = hypotheses.exchanged(hypotheses.prune(hypotheses.best([now, *tried])))
        to_noise = within_band(better.excess_energy, hypotheses.noise_band)
        tolerated = hypotheses.within_form_tolerance(now) and not to_noise
        least = SEARCH.far_log_gain if tolerated else SEARCH.least_log_gain
        if log_energy_ratio(now, better, hypotheses.noise_band) < least:
            break
        now = better
    return now


def _best_trials(
    hypotheses: HypothesisSet, now: Hypothesis, equations: Collection[str]
) -> Iterator[_Trial]:
    """Yield the best candidates' sets, added to the set or in place of one of its effects.

    A candidate must act in one of the `equations`.
    """
    starts = [now.without(used) for used in now.effects]
    if may_grow(now.effects):
        starts.append(now.effects)
    for start in starts:
        yield from _best_additions(hypotheses, now, start, equations)


def _best_additions(
    hypotheses: HypothesisSet, now: Hypothesis, start: Sequence[Used], equations: Collection[str]
) -> list[_Trial]:
    """Return the sets with one more effect that leave least at a point of its shape grid.

    Sets that are physically impossible there would take the places of others.
    """
    data = hypotheses.train_data
    least: dict[Key, _Trial] = {}
    for used in hypotheses.variants_of(data, now.fit.residual):
        effect = effect_in(used)
        fresh = effect.key not in now.keys and not effect.free
        if fresh and hypotheses.may_act(effect, now, equations):
            effects = (*start, used)
            energy = fit_coefficients(data, (*hypotheses.base, *effects)).energy
            if energy < least.get(effect.key, (float("inf"), ()))[0]:
                least[effect.key] = energy, effects
    ordered = sorted(least.values(), key=lambda trial: trial[0])
    possible = (
        trial for trial in ordered
        if not hypotheses.physical_problem(hypotheses.at_given_shapes(trial[1]))
    )  # fmt: skip
    return list(itertools.islice(possible, SEARCH.exact_trials))
