"""Readings: alternative names of one mechanism's law; the simplest one that fits is chosen.

A name is a restriction of its mechanism's law: one level of dry friction where the law has two, no
breakaway, no line behind the tank. The remaining energy cannot show whether a restriction holds,
since its scatter grows with the number of rows. The change that the further number makes in the
whitened held-out rows is one direction, along which the noise has a standard deviation of 1.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import shapes_of
from analysis.simulation.model import Estimate
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in, effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.inference import effect_errors, estimates
from analysis.trace.judge.scatter import form_shift
from analysis.trace.search.exact_fit import fit_coefficients, with_term
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    effect_of,
    keys_of,
    may_grow,
    of_one_law,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


def best_readings(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> Hypothesis:
    """Return the winner with the simplest reading of every mechanism that the records allow.

    Each effect is first replaced by a simpler one that it includes, where `_needs_richer` finds
    that nothing is lost. Then a richer reading replaces a simpler one, or is added to it, as long
    as `_needs_richer` asks for it and it is physical, its further number above the form's tolerance
    included. Of several richer sets within `SEARCH.number_price` of the least energy the one with
    the fewest numbers is chosen.
    """
    winner = _simplified(hypotheses, winner, holdout_data)
    while winner.effects:
        residual = held_out_residual(holdout_data, winner.fit)
        richer = [o for o in _richer_sets(hypotheses, winner) if not hypotheses.physical_problem(o)]
        needed = [o for o in richer if _needs_richer(hypotheses, winner, o, residual, holdout_data)]
        if not needed:
            break
        least = min(o.fit.energy for o in needed)
        similar = [o for o in needed if o.fit.energy <= least + SEARCH.number_price]
        best = min(similar, key=lambda o: (o.size, o.fit.energy))
        log.info("richer reading: %s for %s", sorted(best.keys), sorted(winner.keys))
        winner = best
    return winner


def _simplified(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> Hypothesis:
    """Return the winner with effects replaced by simpler ones they include, if nothing is lost."""
    in_model = {effect.key for effect in effects_among(hypotheses.base)}
    for used in winner.effects:
        effect = effect_in(used)
        for name in effect.includes:
            if (name, effect.where) in in_model:  # the model has this effect already
                continue
            effects = winner.without(used)
            if (name, effect.where) not in winner.keys:
                simple = effect_of(name, effect.where)
                effects = (*effects, at_start(hypotheses.train_data.rig, simple))
            other = hypotheses.refined(effects)
            residual = held_out_residual(holdout_data, other.fit)
            if not hypotheses.physical_problem(other) and not _needs_richer(
                hypotheses, other, winner, residual, holdout_data
            ):
                log.info("simpler reading: %s for %s", sorted(other.keys), sorted(winner.keys))
                return _simplified(hypotheses, other, holdout_data)
    return winner


def loss_in_deviations(restricted: Array, richer: Array) -> float:
    """Return what the restricted model loses to the richer one, in standard deviations of noise.

    Both residuals (M,) are whitened and of records that neither model was fitted to. With
    d = restricted - richer the loss is restricted . d / |d|: a standard normal number if the
    restriction holds, and larger by |d| if the richer model is right.
    """
    change = restricted - richer
    size = float(np.linalg.norm(change))
    return float(restricted @ change) / size if size > 0 else 0.0


def loses_by_restriction(
    restricted: Array, richer: Array, deviations: float = TRACE.standard_errors
) -> bool:
    """Return whether a restricted model loses more than noise to the richer one, and leaves more.

    The loss must exceed `deviations` times its standard deviation by noise. Both residuals (M,) are
    those of `loss_in_deviations`. Where an unknown cause changes the rows along d, the loss alone
    is large for either model: the richer one must have the smaller energy.
    """
    lost = loss_in_deviations(restricted, richer) > deviations
    return lost and float(richer @ richer) < float(restricted @ restricted)


def _needs_richer(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis, residual: Array,
    holdout_data: RegressionData,
) -> bool:  # fmt: skip
    """Return whether training and held-out records need `other`, the richer of two sets.

    In training `other` must remove enough (`_least_removed`). In held-out records `hypothesis`,
    with `residual` (M,) there, must leave more than `other` and lose more than
    `TRACE.standard_errors`. The training rows must determine an effect that is added, and one that
    replaces another must differ from it.
    """
    if hypothesis.fit.energy - other.fit.energy <= _least_removed(hypotheses, hypothesis, other):
        return False
    if not loses_by_restriction(residual, held_out_residual(holdout_data, other.fit)):
        return False
    if len(other.effects) == len(hypothesis.effects):
        return _is_distinct(hypotheses, hypothesis, other)
    new_effects = [u for u in other.effects if u.term.key not in hypothesis.keys]
    return all(
        _is_determined(hypotheses, other, u) and _falls(hypotheses, other, u, holdout_data)
        for u in new_effects
    )


def _least_removed(hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis) -> float:
    """Return the energy that the richer set `other` must remove from the training rows.

    With one more effect what a further effect must. With the same number of effects more than noise
    for each further number, and `_form_error_energy`.
    """
    further = other.size[1] - hypothesis.size[1]
    if len(other.effects) > len(hypothesis.effects):
        return max(SEARCH.number_price * further, SEARCH.add_share * hypothesis.total)
    noise = TRACE.standard_errors**2 * further
    return max(noise, _form_error_energy(hypotheses, hypothesis, other))


def _is_distinct(hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis) -> bool:
    """Return whether the effect of `other` that replaces a simpler one differs from it.

    It removes `TRACE.richer_name_share` of what `hypothesis` leaves, or has intervals that exclude
    the simpler one (`Effect.distinct`): two levels of friction remove little where a change of W
    makes most of their difference. A number that removes little may only adapt the form of a law
    that leaves form error beside noise.
    """
    removed = hypothesis.fit.energy - other.fit.energy
    if removed > TRACE.richer_name_share * hypothesis.total:
        return True
    return all(
        effect_in(u).distinct({n: e.ci95 for n, e in _numbers(hypotheses, other, u).items()})
        for u in other.effects
        if u.term.key not in hypothesis.keys
    )


def _is_determined(hypotheses: HypothesisSet, hypothesis: Hypothesis, used: Used) -> bool:
    """Return whether no 95 % interval of an effect's numbers holds 0, details of its form aside.

    With a Stribeck speed far above those of the records, the breakaway is a second Coulomb level,
    and the rows determine only the sum of the two.
    """
    shapes = shapes_of(hypotheses.train_data.rig, used)
    details = {s.parameter for s in shapes if s.detail or s.resolution}
    numbers = _numbers(hypotheses, hypothesis, used)
    intervals = [e.ci95 for name, e in numbers.items() if name not in details]
    return all(not low <= 0.0 <= high for low, high in intervals)


def _falls(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, used: Used, holdout_data: RegressionData
) -> bool:
    """Return whether a further friction at a place falls with speed, of those that can.

    Training and held-out records must need the fall: two contacts of one level, one with memory and
    one without, fit a reversal that neither fits alone.
    """
    data, fit = hypotheses.train_data, hypothesis.fit
    shape = effect_in(used).without_fall(data.rig, used.shape)
    if shape is None:
        return True
    level = fit_coefficients(data, with_term(fit.terms, used, Used(used.term, shape)))
    removed = level.energy - fit.energy
    residual, other = (held_out_residual(holdout_data, model) for model in (level, fit))
    return removed > SEARCH.number_price and loses_by_restriction(residual, other)


def _numbers(hypotheses: HypothesisSet, hypothesis: Hypothesis, used: Used) -> dict[str, Estimate]:
    """Return an effect's numbers with 95 % intervals, errors of the forms included."""
    data, fit = hypotheses.train_data, hypothesis.fit
    return estimates(data, used, effect_errors(data, fit, used), form_shift(data, fit))


def _form_error_energy(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, other: Hypothesis
) -> float:
    """Return the energy above noise that the richer set leaves, 0 if it is far from the simpler.

    Where the numbers of the richer reading differ little, its further number may only adapt to an
    error of its form, which is as large as this energy.
    """
    rig = hypotheses.train_data.rig
    values = other.fit.parameters(rig)
    is_near = any(
        (effect.simpler_equivalent(rig, values, TRACE.near_tolerance), effect.where)
        in hypothesis.keys
        for effect in effects_among(other.effects)
    )
    remaining = sum(max(0.0, v - hypotheses.noise_band[e]) for e, v in other.excess_energy.items())
    return remaining if is_near else 0.0


def _richer_sets(hypotheses: HypothesisSet, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Return the sets with a richer reading of one effect.

    It replaces the effect if it includes it, or is added if either is a part `beside` the other.
    """
    rig, sets = hypotheses.train_data.rig, dict[frozenset[Key], tuple[Used, ...]]()
    for used in hypothesis.effects:
        member = effect_in(used)
        for effect in hypotheses.effects:
            if not of_one_law(effect, member) or effect.key in hypothesis.keys:
                continue
            others = hypothesis.without(used)
            if effect.beside or member.beside:
                others = (*others, used)
            elif member.name not in effect.includes:
                continue
            if not may_grow(others):
                continue
            effects = (*others, at_start(rig, effect))
            sets[keys_of(effects)] = effects
    return [hypotheses.refined(effects) for effects in sets.values()]
