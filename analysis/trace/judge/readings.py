"""Readings of one mechanism: whether the simpler name loses more than noise and its form may.

A name is a restriction of its mechanism's law: one level of dry friction where the law has two, no
breakaway, no line behind the tank. The energy that a fit leaves cannot show whether a restriction
holds, for its scatter grows with all rows; what the number set to nothing would change in the
held-out rows is one direction in them, along which noise is one.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.search.hypothesis import Hypothesis, Key, parameter_values
from analysis.trace.search.hypothesis_set import HypothesisSet, effect_of
from analysis.trace.settings import SEARCH, TRACE

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


def best_readings(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> Hypothesis:
    """Return the winner with the simplest reading of every mechanism that loses no more than noise.

    First each effect is tried as one that it includes. A richer reading then takes the place of
    one that it includes, or stands beside it. It must be physical, which asks that its own number
    is more than a form's tolerance. By the restriction training records must lose
    `TRACE.richer_name_share` of what it leaves and more than `TRACE.standard_errors` of their noise for
    each number, held-out ones as much of theirs. Where the numbers differ little, the further one
    must take more than the richer form itself leaves; beside a name it must take the share of what
    is left that a further effect must. Of several that leave about as little the one with the
    fewest numbers stays.
    """
    winner = _simplified(hypotheses, winner, holdout_data)
    while winner.effects:
        held = held_out_residual(holdout_data, winner.fit)
        richer = [o for o in _richer_sets(hypotheses, winner) if not hypotheses.physical_problem(o)]
        kept = [o for o in richer if _needs_richer(hypotheses, winner, o, held, holdout_data)]
        if not kept:
            break
        least = min(o.fit.energy for o in kept)
        near = [o for o in kept if o.fit.energy <= least + SEARCH.number_price]
        best = min(near, key=lambda o: (o.size, o.fit.energy))
        log.info("richer reading: %s for %s", sorted(best.keys), sorted(winner.keys))
        winner = best
    return winner


def _simplified(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> Hypothesis:
    """Return the winner with every effect as the one it includes, where nothing is lost by that."""
    known = {(u.term.name, u.term.where) for u in hypotheses.base if isinstance(u.term, Effect)}
    for used in winner.effects:
        assert isinstance(used.term, Effect)
        for name in used.term.includes:
            if (name, used.term.where) in known:  # the model has it: it is no new name
                continue
            effects = [u for u in winner.effects if u is not used]
            if (name, used.term.where) not in winner.keys:
                simple = effect_of(name, used.term.where)
                shape = simple.shape_of(hypotheses.train_data.rig, ())
                effects.append(Used(simple, shape))
            other = hypotheses.refined(effects)
            held = held_out_residual(holdout_data, other.fit)
            if not hypotheses.physical_problem(other) and not _needs_richer(
                hypotheses, other, winner, held, holdout_data
            ):
                log.info("simpler reading: %s for %s", sorted(other.keys), sorted(winner.keys))
                return _simplified(hypotheses, other, holdout_data)
    return winner


def loss_in_deviations(restricted: Array, richer: Array) -> float:
    """Return by how many standard deviations of noise residuals (M,) lose by a restriction.

    Both are whitened and of records that neither was fitted to. Noise alone gives a normal number;
    what the richer model says rightly adds the length of the difference.
    """
    change = restricted - richer
    size = float(np.linalg.norm(change))
    return float(restricted @ change) / size if size > 0 else 0.0


def of_one_law(effect: Effect, other: Effect) -> bool:
    """Return whether one of two effects is a reading of the other's law at the same place."""
    near = effect.name in other.includes or other.name in effect.includes
    return near and effect.where == other.where


def _needs_richer(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis, held: Array,
    holdout_data: RegressionData,
) -> bool:  # fmt: skip
    """Return whether training and held-out records lose by taking `one` for the richer `other`."""
    more = other.size[1] - hypothesis.size[1]
    if len(other.effects) > len(hypothesis.effects):
        least = max(SEARCH.number_price * more, SEARCH.add_share * hypothesis.total)
    else:
        # What a law leaves is no noise alone: a number that takes a little of it bends the form.
        share = TRACE.richer_name_share * hypothesis.total
        noise = TRACE.standard_errors**2 * more
        least = max(noise, share, _form_error_energy(hypotheses, hypothesis, other))
    if hypothesis.fit.energy - other.fit.energy <= least:
        return False
    return (
        loss_in_deviations(held, held_out_residual(holdout_data, other.fit)) > TRACE.standard_errors
    )


def _form_error_energy(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis
) -> float:
    """Return the energy that the richer of two readings leaves, where it is nearly the simpler one.

    Where its numbers differ little, so much may be the form's error and no further number.
    """
    values = parameter_values(hypotheses.train_data.rig, other.fit.terms, dict(other.fit.beta))
    near = any(
        (u.term.simpler(hypotheses.train_data.rig, values, TRACE.near_tolerance), u.term.where)
        in hypothesis.keys
        for u in other.effects
        if isinstance(u.term, Effect)
    )
    left = sum(max(0.0, v - hypotheses.noise_band.band[e]) for e, v in other.excess_energy.items())
    return left if near else 0.0


def _richer_sets(hypotheses: HypothesisSet, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Return the sets with a further number of a mechanism's law.

    A reading takes the place of one that it includes; another part of the same law stands beside.
    """
    rig, sets = hypotheses.train_data.rig, dict[frozenset[Key], tuple[Used, ...]]()
    for used in hypothesis.effects:
        assert isinstance(used.term, Effect)
        for effect in hypotheses.effects:
            if not of_one_law(effect, used.term) or (effect.name, effect.where) in hypothesis.keys:
                continue
            kept = [u for u in hypothesis.effects if u is not used]
            if effect.beside or used.term.beside:
                kept.append(used)
            elif used.term.name not in effect.includes:
                continue
            if len(kept) == SEARCH.largest_set:
                continue
            effects = (*kept, Used(effect, effect.shape_of(rig, ())))
            sets[frozenset((u.term.name, u.term.where) for u in effects)] = effects
    return [hypotheses.refined(effects) for effects in sets.values()]
