"""Rivals: other effects that explain the records as well, or nearly, as a named one."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.identify.settings import IDENTIFY
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import details, effect_in, effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge import held_out
from analysis.trace.judge.curves import noise_covariance
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.readings import loss_in_deviations
from analysis.trace.result import JudgedEffect, Rival
from analysis.trace.search.exact_fit import (
    ExactFit,
    fit_coefficients,
    over_amplified_noise,
    rescale,
)
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    energy_above_noise,
    is_special_case,
    of_one_law,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TiedPair:
    """A fitted set with two `effects` in the place of one, tied with it in held-out rows.

    `ratio` is that of `TieTest`, `cost` the energy of the set with the price of its numbers.
    """

    hypothesis: Hypothesis
    effects: tuple[Used, Used]
    ratio: float
    cost: float


def rivals_of(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    used: Used,
    alternative: Hypothesis,
    held_out_test: TieTest,
    pairs: Sequence[TiedPair],
) -> list[Rival]:
    """Return the rivals of an effect: fitted sets with another effect, or a pair, in its place.

    Tied rivals come first, then by held-out rms. A simpler reading of the effect is no rival, since
    held-out records have shown that it is too simple; a richer one is a rival where it changes a
    parameter of another law, or where another rival is tied.
    """
    comparison = _Comparison(hypotheses, winner, used, alternative, held_out_test)
    out: list[Rival] = []
    richer: list[Rival] = []
    for hypothesis, (rival_term,) in hypotheses.replacements(winner, used):
        rival = comparison.rival(hypothesis, effect_in(rival_term))
        if rival is not None:
            only_richer = rival.moved is None and comparison.of_same_law(effect_in(rival_term))
            (richer if only_richer else out).append(rival)
    out += comparison.rival_pairs(pairs)
    if any(rival.tied for rival in out):
        out += [rival for rival in richer if rival.tied]
    out.sort(key=lambda r: (not r.tied, r.ratio))
    return out[: max(TRACE.most_rivals, sum(r.tied for r in out))]


@dataclass(frozen=True)
class _Comparison:
    """Comparison of fitted sets with the winner, of which they lack the effect `used`.

    `alternative` is the set without it, `held_out_test` compares in the held-out rows.
    """

    hypotheses: HypothesisSet
    winner: Hypothesis
    used: Used
    alternative: Hypothesis
    held_out_test: TieTest

    @functools.cached_property
    def training_test(self) -> TieTest:
        """The comparison in the training rows."""
        return TieTest(
            self.hypotheses.train_data,
            held_out.removed_energy(self.winner, self.alternative),
            self.winner.fit.residual,
            self.alternative.fit.residual,
        )

    def of_same_law(self, other: Effect) -> bool:
        """Return whether another effect is a simpler or richer form of the effect."""
        return of_one_law(effect_in(self.used), other)

    def rival(self, fitted: Hypothesis, other: Effect) -> Rival | None:
        """Return the effect `other` of a fitted set as a rival, None where it is none."""
        train_data, rig = self.hypotheses.train_data, self.hypotheses.train_data.rig
        hypothesis = _over_its_noise(train_data, fitted)
        effect, same_law = effect_in(self.used), self.of_same_law(other)
        held_out_limit, training_limit = TRACE.tie_ratio, TRACE.tie_ratio_training
        if details(rig, hypothesis.effects) > details(rig, self.winner.effects):
            held_out_limit = training_limit = TRACE.tie_ratio_detailed
        justified = self._pays_for_numbers(hypothesis)
        alike = self.training_test.ties(hypothesis.fit.residual, training_limit)
        if not (justified or alike) or not self._is_possible(hypothesis, same_law):
            return None
        holdout_data, others = self.held_out_test.data, self.winner.keys - {effect.key}
        residual = _held_out(holdout_data, hypothesis)
        pair = (effect, other)
        if _is_refused_simpler_name(self.hypotheses, holdout_data, pair, others, residual):
            return None
        ratio = self.held_out_test.ratio(residual)
        tied = self.held_out_test.ties(residual, held_out_limit)
        tied = tied and (alike or ratio < TRACE.decisive_ratio)
        law = effect.family if same_law else ""
        moved = moved_parameter(train_data, self.winner, hypothesis, law) if tied else None
        # However many numbers it has: a free form has no parameters to compare.
        free = any(effect.free for effect in effects_among(hypothesis.effects))
        if not same_law and not justified and (moved is None or free):
            return None
        training_ratio = self.training_test.ratio(hypothesis.fit.residual)
        return _rival(other, ratio, training_ratio, tied, moved)

    def _pays_for_numbers(self, hypothesis: Hypothesis) -> bool:
        """Return whether each free number beyond the winner's removes its price."""
        further = hypothesis.size[1] - self.winner.size[1]
        price = SEARCH.number_price * further
        return further <= 0 or hypothesis.total <= self.winner.total - price

    def _is_possible(self, hypothesis: Hypothesis, same_law: bool) -> bool:
        """Return whether a set is physical, disturbs no equation, and is no simpler reading."""
        hypotheses, others = self.hypotheses, self.winner.keys - {self.used.term.key}
        return (
            not (same_law and hypothesis.size <= self.winner.size)
            and not hypotheses.physical_problem(hypothesis, may_be_at_bounds=others)
            and not held_out.disturbed_equations(hypotheses, hypothesis, self.alternative)
        )

    def rival_pairs(self, pairs: Sequence[TiedPair]) -> list[Rival]:
        """Return the pairs that change a parameter and that training and held-out rows prefer.

        Otherwise one effect is the simpler explanation.
        """
        train_data, out = self.hypotheses.train_data, []
        least = cost(train_data, self.winner, self.held_out_test.data) if pairs else 0.0
        for pair in (p for p in pairs if p.cost < least):
            moved = moved_parameter(train_data, self.winner, pair.hypothesis)
            if moved:
                ratios = pair.ratio, self.training_test.ratio(pair.hypothesis.fit.residual)
                one, two = (_rival(effect_in(u), *ratios, True) for u in pair.effects)
                out.append(replace(one, moved=moved, beside=two))
        return out


def replaced_as_rivals(
    hypotheses: HypothesisSet, winner: Hypothesis, other: Hypothesis, holdout_data: RegressionData
) -> list[Rival]:
    """Return the effects of a set that `other` replaces, as tied rivals; none if that fits worse.

    It fits as well if it loses no more than tied rivals do in the equations in which they act.
    """
    replaced = [used for used in winner.effects if used.term.key not in other.keys]
    without = hypotheses.refined([used for used in winner.effects if used not in replaced])
    equations = held_out.removed_energy(winner, without)
    unseen, after, before = (
        held_out_residual(holdout_data, o.fit) for o in (other, winner, without)
    )
    test = TieTest(holdout_data, equations, after, before)
    if not test.ties(unseen, TRACE.tie_ratio):
        return []
    in_training = TieTest(
        hypotheses.train_data, equations, winner.fit.residual, without.fit.residual
    )
    ratios = 1.0 / test.ratio(unseen), 1.0 / in_training.ratio(other.fit.residual)
    return [_rival(effect_in(used), *ratios, tied=True) for used in replaced]


def _over_its_noise(data: RegressionData, hypothesis: Hypothesis) -> Hypothesis:
    """Return a set with its residual over the noise that its effects amplify."""
    residual = over_amplified_noise(data, hypothesis.fit, hypothesis.fit.residual)
    fit, energy = replace(hypothesis.fit, residual=residual), energy_above_noise(data, residual)
    return replace(hypothesis, fit=fit, excess_energy=energy)


def _held_out(holdout_data: RegressionData, hypothesis: Hypothesis) -> Array:
    """Return the held-out residual (M,) of a set over the noise that its effects amplify."""
    fit = hypothesis.fit
    return over_amplified_noise(holdout_data, fit, held_out_residual(holdout_data, fit))


def _rival(
    effect: Effect, ratio: float, training_ratio: float, tied: bool,
    moved: tuple[str, float] | None = None,
) -> Rival:  # fmt: skip
    return Rival(effect.name, effect.place, ratio, training_ratio, tied, effect.where, moved)


def moved_parameter(
    train_data: RegressionData, winner: Hypothesis, rival: Hypothesis, law: str = "",
    least: float = TRACE.noted_shift, with_open: bool = True,
) -> tuple[str, float] | None:  # fmt: skip
    """Return the baseline parameter that a rival changes most, and its relative change.

    It changes by at least `least` and lies outside the rival's 95 % interval. `with_open`: or it
    lies inside, and the interval is wider than the winner's by `TRACE.open_share` of the value, as
    a root of squares; then the end by that width gives the change. The stated intervals would be
    wrong if the rival were true. None where no parameter does.
    With a `law`, parameters of the baseline's term of that law are left out (viscous friction
    beside dry `friction`, whose forms differ by a slope too).
    """
    std, own_std = (deviations(train_data, hypothesis.fit) for hypothesis in (rival, winner))
    largest: tuple[str, float] | None = None
    rig = train_data.rig
    left_out = law_parameters(rig, law)
    for c in (c for term in baseline_of(rig) for c in term.coefficients(rig)):
        if c.parameter in left_out:
            continue
        value, other = (h.fit.beta.get(c.parameter, 0.0) for h in (winner, rival))
        if not value or not other or c.parameter not in std or c.parameter not in own_std:
            continue
        half_width = IDENTIFY.normal_quantile * std[c.parameter]
        if abs(other - value) <= half_width:
            own = IDENTIFY.normal_quantile * own_std[c.parameter]
            wider = math.sqrt(max(half_width**2 - own**2, 0.0))
            if not with_open or wider <= TRACE.open_share * abs(value):
                continue
            other += math.copysign(wider, other - value)
        change = value / other - 1.0 if c.reciprocal else other / value - 1.0
        if abs(change) > max(least, abs(largest[1]) if largest else 0.0):
            largest = c.parameter, float(change)
    return largest


def deviations(data: RegressionData, fit: ExactFit) -> dict[str, float]:
    """Return the standard deviations by noise of a fit's coefficients, by name.

    Coefficients that the rows do not determine are left out: the pseudo-inverse gives them a
    variance below 1 / I, with their information I.
    """
    names, covariance = noise_covariance(data, fit)
    variance = dict(zip(names, np.diag(covariance).tolist(), strict=True))
    information = zip(fit.beta, np.diag(fit.information).tolist(), strict=True)
    return {n: math.sqrt(variance[n]) for n, known in information if variance[n] * known > 0.5}


def tied_sets(
    hypotheses: HypothesisSet, winner: Hypothesis, effects: Sequence[JudgedEffect]
) -> list[Hypothesis]:
    """Return the fitted sets with a tied rival in place of one judged effect of the winner."""
    keys = (
        winner.keys - {(effect.name, effect.at)} | {(r.name, r.at) for r in rival.effects}
        for effect in effects for rival in effect.rivals if rival.tied
    )  # fmt: skip
    return [hypotheses.fitted[k] for k in keys if k in hypotheses.fitted]


def best_tied_set(
    hypotheses: HypothesisSet, winner: Hypothesis, effects: Sequence[JudgedEffect],
    holdout_data: RegressionData,
) -> Hypothesis:  # fmt: skip
    """Return the winner, or the set with a tied rival that training and held-out rows prefer.

    It leaves less energy by more than `SEARCH.number_price`, and by that for each further effect
    and free number: the search saw the training rows only. A richer name of a law of the winner is
    left out: `readings.best_readings` has found that none is needed.
    """

    def is_richer(hypothesis: Hypothesis) -> bool:
        named, others = effects_among(winner.effects), effects_among(hypothesis.effects)
        return any(is_special_case(effect, other) for effect in named for other in others)

    tied = [o for o in tied_sets(hypotheses, winner, effects) if not is_richer(o)]
    data = hypotheses.train_data
    best = min(tied, key=lambda o: cost(data, o, holdout_data), default=winner)
    limit = cost(data, winner, holdout_data) - SEARCH.number_price
    return best if cost(data, best, holdout_data) < limit else winner


def cost(train_data: RegressionData, hypothesis: Hypothesis, holdout_data: RegressionData) -> float:
    """Return the energy in training and held-out rows with the price of effects and numbers.

    Rows of a set that rescales signals are scaled back: a gain below 1 makes their noise smaller.
    """
    fit = hypothesis.fit
    if rescale(train_data, fit.terms):
        fit = fit_coefficients(replace(train_data, relative=True), fit.terms)
        holdout_data = replace(holdout_data, relative=True)
    residual = held_out_residual(holdout_data, fit)
    energy = fit.energy + float(residual @ residual)
    return energy + SEARCH.number_price * sum(hypothesis.size)


def law_parameters(rig: Rig, law: str) -> set[str]:
    """Return the parameters of the baseline's term of a law ('': of none)."""
    terms = [term for term in baseline_of(rig) if law and term.name.endswith(law)]
    return {c.parameter for term in terms for c in term.coefficients(rig)}


def tied_pairs(
    hypotheses: HypothesisSet, winner: Hypothesis, used: Used, held_out_test: TieTest
) -> list[TiedPair]:
    """Return the sets with two effects in the place of one that leave as little in held-out rows.

    The set that costs least comes first.
    """
    holdout_data, out = held_out_test.data, []
    for hypothesis, (first, second) in hypotheses.replacements(winner, used, by=2):
        residual = held_out_residual(holdout_data, hypothesis.fit)
        tied = held_out_test.ties(residual, TRACE.tie_ratio)
        if tied and not hypotheses.physical_problem(hypothesis):
            price = cost(hypotheses.train_data, hypothesis, holdout_data)
            ratio = held_out_test.ratio(residual)
            out.append(TiedPair(hypothesis, (first, second), ratio, price))
    return sorted(out, key=lambda pair: pair.cost)


def pair_in_words(pairs: Sequence[TiedPair]) -> str:
    """Name the best two effects that together leave as little as one ('' if none do).

    They are no rival where no parameter changes with them, since one effect is simpler.
    """
    if not pairs:
        return ""
    names = " and ".join(u.term.name for u in pairs[0].effects)
    return f"; {names} together would leave {pairs[0].ratio:.2f} times the held-out rms"


def _is_refused_simpler_name(
    hypotheses: HypothesisSet, holdout_data: RegressionData, pair: tuple[Effect, Effect],
    others: frozenset[Key], rival_residual: Array,
) -> bool:  # fmt: skip
    """Return whether a rival fits no better than a simpler reading of both, which is too simple.

    `rival_residual` (M,) is that of the held-out rows, `others` the set's other effects.
    """
    effect, other = pair
    for name in set(other.includes) & set(effect.includes) if other.where == effect.where else ():
        simple = hypotheses.fitted.get(others | {(name, other.where)})
        if simple is not None:
            loss = loss_in_deviations(held_out_residual(holdout_data, simple.fit), rival_residual)
            return loss <= TRACE.standard_errors
    return False


class TieTest:
    """Comparison of other fits with the best one, in the equations in which an effect acts.

    `residual` (M,) is the whitened one of the best fit, `without` (M,) that without the effect.
    """

    def __init__(
        self, data: RegressionData, equations: Collection[str], residual: Array, without: Array
    ) -> None:
        self.data, self.rows = data, data.in_equations(equations)
        self.residual = residual[self.rows]
        self.energy = float(self.residual @ self.residual)
        self.removed = float(without[self.rows] @ without[self.rows]) - self.energy

    def ratio(self, other: Array) -> float:
        """Return the residual rms of another fit (M,) over that of the best."""
        energy = float(other[self.rows] @ other[self.rows])
        return float(np.sqrt(energy / self.energy)) if self.energy > 0 else float("nan")

    def ties(self, other: Array, tie: float) -> bool:
        """Return whether another fit (M,) has less than `tie` times the rms, or loses only noise.

        For an effect that removes less energy than remains, the ratio is of the removed energy.
        """
        residual = other[self.rows]
        lost = float((residual - self.residual) @ (residual + self.residual))
        allowed = (tie**2 - 1.0) * min(self.energy, max(self.removed, 0.0))
        deviations = loss_in_deviations(residual, self.residual)
        return lost < allowed or deviations <= TRACE.standard_errors


def rivals_in_words(rivals: Sequence[Rival]) -> str:
    """Say which rivals fit as well, or else how near the closest comes."""
    if not rivals:
        return "no other set fits nearly as well"
    nearest = rivals[0]
    words = "cannot be separated from" if nearest.tied else "the closest is"
    training = nearest.training_ratio
    in_training = f", {training:.2f} times the training rms" if np.isfinite(training) else ""
    return (
        f"{words} {nearest.name} at {nearest.location}: {nearest.ratio:.2f} times the held-out rms"
        f"{in_training}"
    )
