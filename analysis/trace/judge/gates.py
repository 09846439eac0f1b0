"""Gates: the conditions that an effect must meet to be named.

Significance is not enough, since a model error makes every correlated candidate significant. The
cause differs from these in that it reduces the error of records with another excitation, has a
physically possible size, has the same size in all parts of the records, and fits better than any
other effect.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge import inference
from analysis.trace.judge.curves import curves_of, noise_covariance
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.invariance import Difference, invariance
from analysis.trace.judge.readings import loss_in_deviations, of_one_law
from analysis.trace.judge.scatter import form_shift
from analysis.trace.result import Gate, JudgedEffect, Rival
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise, parameter_values
from analysis.trace.search.hypothesis_set import HypothesisSet, effect_of
from analysis.trace.search.refinement import ExactFit
from analysis.trace.settings import SEARCH, TRACE
from rig.model.units import plain, with_interval

Array = NDArray[np.float64]
Key = tuple[str, str]


REMOVES, PHYSICAL, INVARIANT, SIGNIFICANT, NO_RIVAL = (
    "removes on held-out", "physical", "invariant", "significant", "no rival",
)  # fmt: skip


def passes_gates(effect: JudgedEffect) -> bool:
    """Return whether an effect passes every gate but that of rivals, which makes it confounded."""
    return all(gate.ok for gate in effect.gates if gate.name != NO_RIVAL)


def refused_effects(effects: Sequence[JudgedEffect]) -> tuple[JudgedEffect, ...]:
    """Return the effects that fail a gate, each once, those that remove most first.

    An effect that passes the gates in one of its judgements is left out.
    """
    once: dict[Key, JudgedEffect] = {}
    for effect in sorted(effects, key=lambda f: (not passes_gates(f), -f.removed_fraction)):
        once.setdefault((effect.name, effect.at or effect.where), effect)
    return tuple(f for f in once.values() if not passes_gates(f))


def judge_effects(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    holdout_data: RegressionData,
    rng: np.random.Generator,
) -> tuple[JudgedEffect, ...]:
    """Return every effect of the set `winner` with its gates, rivals, parameters and intervals.

    `holdout_data` are the choosing rows; `rng` draws the sign flips.
    """
    train_data = hypotheses.train_data
    values = parameter_values(train_data.rig, winner.fit.terms, dict(winner.fit.beta))
    null = inference.null_maximum(
        hypotheses.candidates, train_data, _noise_samples(train_data, winner.fit.residual), rng
    )
    before, after = (held_out_residual(holdout_data, o.fit) for o in (hypotheses.empty, winner))
    shift = form_shift(train_data, winner.fit)
    out = []
    for used in winner.effects:
        assert isinstance(used.term, Effect)
        alternative = _set_without(hypotheses, winner, used)
        without = held_out_residual(holdout_data, alternative.fit)
        changes = _removed_energy(winner, alternative)
        tie_test = _TieTest(holdout_data, changes, after, without)
        rivals = _rivals(hypotheses, winner, used, alternative, holdout_data, tie_test)
        removed = _removed_share(holdout_data, changes, without, after)
        disturbed = {
            *_disturbed_equations(hypotheses, winner, alternative),
            *_disturbed_in_held_out(holdout_data, before, without, after),
        }
        p = inference.p_value(alternative.fit.energy - winner.fit.energy, null)
        errors = inference.effect_errors(train_data, winner.fit, used, values)
        differing = invariance(train_data, winner.fit, used, errors, _joint_index(used.term))
        unphysical = hypotheses.physical_problem(winner, used)
        tied = [r for r in rivals if r.tied]
        inseparable = [
            Rival(name, _place(effect_of(name, at)), 1.0, 1.0, True, at)
            for name, at in used.term.inseparable()
        ]
        gates = (
            Gate(
                REMOVES,
                removed >= TRACE.least_removed and not disturbed,
                _removal_in_words(removed, disturbed),
            ),
            Gate(PHYSICAL, not unphysical, unphysical or "sign and size are possible"),
            Gate(INVARIANT, not differing, _differences_in_words(differing)),
            Gate(SIGNIFICANT, p <= TRACE.p_limit, f"family-wise p = {p:.3g}"),
            Gate(
                NO_RIVAL,
                not (tied or inseparable),
                rivals_in_words([*inseparable, *rivals])
                + _composites_in_words(hypotheses, winner, used, holdout_data, tie_test),
            ),
        )
        out.append(
            JudgedEffect(
                used.term.name,
                _place(used.term),
                inference.estimates(train_data, used, errors, shift),
                p,
                removed,
                (*inseparable, *rivals),
                gates,
                used.term.variable,
                mechanism=used.term.mechanism,
                free=used.term.free,
                curves=curves_of(train_data, winner.fit, used),
                left_without=_rms(holdout_data, without, changes),
                left_with=_rms(holdout_data, after, changes),
                at=used.term.where,
            )
        )
    return tuple(out)


def _set_without(hypotheses: HypothesisSet, winner: Hypothesis, used: Used) -> Hypothesis:
    """Return the set without one effect and its other readings, as the alternative to the effect.

    An unphysical set is no alternative (two levels of friction of opposite signs make a torque
    offset): then the best physical set of the other effects or readings of them is returned. Two
    readings of one law are removed together, since `readings` decides whether both are needed.
    """
    kept = [u for u in winner.effects if u is not used and not of_one_law(u.term, used.term)]  # type: ignore[arg-type]
    without = hypotheses.refined(kept)
    rig = hypotheses.train_data.rig
    # A shape at its bound is an error of the form, not of physics.
    at_bound = any(u.term.outside(rig, u.shape) for u in without.effects)  # type: ignore[attr-defined]
    if at_bound or not hypotheses.physical_problem(without):
        return without

    def is_kept(other: Used) -> bool:
        """Return whether a kept effect, or one of its readings, is another set's effect."""
        return any(other.term == k.term or of_one_law(other.term, k.term) for k in kept)  # type: ignore[arg-type]

    physical = [o for o in hypotheses.fitted.values() if not hypotheses.physical_problem(o)]
    simpler = [o for o in physical if all(map(is_kept, o.effects))]
    return min([hypotheses.empty, *simpler], key=lambda o: o.total)


def equations_above_band(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> list[tuple[str, str]]:
    """Return the equations that keep more than the band, and in words how much in which records.

    Held-out records judge a set of effects (`held_out_above_band`); without any effect, training
    records must hold no more than noise either (`HypothesisSet.negligible`).
    """
    band = hypotheses.noise_band.by_equation
    out = [
        (e, f"the repeatable energy is {plain(energy / band[e], 2)} times the band")
        for e, energy in winner.excess_energy.items()
        if not winner.effects and not hypotheses.negligible(e, energy)
    ]
    held_out = held_out_above_band(holdout_data, hypotheses.empty.fit, winner.fit)
    return out + [(e, f"{words} in the rows that choose") for e, words in held_out]


def held_out_above_band(
    holdout_data: RegressionData, before: ExactFit, after: ExactFit
) -> list[tuple[str, str]]:
    """Return the equations that keep more than the band in held-out rows, and in words how much.

    The band is an rms of `TRACE.held_out_band` noise floors or `TRACE.held_out_share` of the energy
    above noise that the model `before` leaves, whichever is larger.
    """
    left = held_out_residual(holdout_data, after)
    start = energy_above_noise(holdout_data, held_out_residual(holdout_data, before))
    now = energy_above_noise(holdout_data, left)
    return [
        (e, f"held-out error {r:.2f} times the noise floor")
        for e, r in error_over_floor(holdout_data, left).items()
        if r > TRACE.held_out_band and now[e] > TRACE.held_out_share * start[e]
    ]


def _rms(data: RegressionData, residual: Array, equations: Collection[str]) -> float:
    """Return the rms of whitened residuals (M,) in some equations; NaN where they have no rows."""
    parts = [residual[s.where] for s in data.segments if s.equation in equations]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else float("nan")


def error_over_floor(holdout_data: RegressionData, residual: Array) -> dict[str, float]:
    """Return the held-out error of single records over the noise floor, by equation."""
    floor: dict[str, float] = {}
    energy: dict[str, float] = {}
    for s in holdout_data.segments:
        count = (s.where.stop - s.where.start) * s.repeats
        floor[s.equation] = floor.get(s.equation, 0.0) + count * s.noise**2
        # The average has less noise than a record: the difference is added.
        part = residual[s.where]
        record_energy = float(part @ part) + count * (1 - 1 / s.repeats)
        energy[s.equation] = energy.get(s.equation, 0.0) + record_energy * s.noise**2
    return {e: float(np.sqrt(energy[e] / floor[e])) for e in floor}


def _noise_samples(train_data: RegressionData, residual: Array) -> Array:
    """Return samples (R, M) of the noise: the repeats' residuals without their mean.

    They are scaled to the full noise. A step with one repeat has the `residual` (M,) of the winner.
    """
    out = train_data.residual.copy()
    for s in train_data.segments:
        if s.repeats > 1:
            part = out[: s.repeats, s.where]
            scale = np.sqrt(s.repeats / (s.repeats - 1))
            out[: s.repeats, s.where] = (part - part.mean(axis=0)) * scale
        else:
            out[0, s.where] = residual[s.where]
    return out


def _joint_index(effect: Effect) -> int | None:
    words = effect.where.split()
    return int(words[1]) - 1 if words[0] == "joint" else None


def _place(effect: Effect) -> str:
    return str(getattr(effect, "place", effect.where))


def _removed_energy(winner: Hypothesis, alternative: Hypothesis) -> dict[str, float]:
    """Return the training energy that an effect removes, by equation in which it acts."""
    change = {
        e: alternative.excess_energy[e] - winner.excess_energy[e] for e in alternative.excess_energy
    }
    most = max(change.values())
    return {e: v for e, v in change.items() if v > SEARCH.acting_share * most}


def _disturbed_equations(
    hypotheses: HypothesisSet, winner: Hypothesis, alternative: Hypothesis
) -> list[str]:
    """Return the equations in which an effect leaves more energy than the baseline.

    It must be more by the noise's band and by `TRACE.harm_ratio`, and more than without the effect.
    """
    before = {e: max(0.0, v) for e, v in hypotheses.empty.excess_energy.items()}
    return [
        e
        for e, now in winner.excess_energy.items()
        if now > before[e] + hypotheses.noise_band.by_equation[e]
        and now > TRACE.harm_ratio * before[e]
        and now > alternative.excess_energy[e]
    ]


def _disturbed_in_held_out(
    holdout_data: RegressionData, before: Array, without: Array, after: Array
) -> list[str]:
    """Return the equations in which held-out records lose by an effect.

    Their error exceeds `TRACE.noted_ratio` noise floors, and their energy above noise exceeds that
    of the baseline by `TRACE.harm_ratio` and that without the effect. `before`, `without` and
    `after` (M,) are the whitened residuals of the baseline, and without and with the effect.
    """
    start, alone, now = (energy_above_noise(holdout_data, r) for r in (before, without, after))
    return [
        e
        for e, ratio in error_over_floor(holdout_data, after).items()
        if ratio > TRACE.noted_ratio
        and now[e] > max(TRACE.harm_ratio * max(0.0, start[e]), alone[e])
    ]


def _removal_in_words(removed: float, disturbed: Collection[str]) -> str:
    text = f"{100 * removed:.0f} % of the energy above noise"
    if not disturbed:
        return text
    equations = " ".join(sorted(disturbed))
    return f"{text}, but the residual of {equations} is larger than under the baseline"


def _removed_share(
    holdout_data: RegressionData, changes: Mapping[str, float], without: Array, after: Array
) -> float:
    """Return the share of held-out energy above noise that an effect removes.

    It is the mean over equations, weighted by the training energy that the effect removes in each
    (`changes`): an error of the baseline in another equation does not count against the effect.
    """
    before, now = energy_above_noise(holdout_data, without), energy_above_noise(holdout_data, after)
    weights = {e: v for e, v in changes.items() if before.get(e, 0.0) > 0.0}
    total = sum(weights.values())
    if total <= 0.0:
        return 0.0
    return (
        sum(weight * max(-1.0, 1.0 - max(0.0, now[e]) / before[e]) for e, weight in weights.items())
        / total
    )


def _rivals(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    used: Used,
    alternative: Hypothesis,
    holdout_data: RegressionData,
    held_out_test: _TieTest,
) -> list[Rival]:
    """Return the rivals of an effect: fitted sets with another effect in its place.

    Tied rivals come first, then by held-out rms. A simpler reading of the effect is no rival, since
    held-out records have shown that it is too simple; a richer one is a rival where it changes a
    parameter of another law.
    """
    judged_effect, train_data = used.term, hypotheses.train_data
    others = winner.keys - {(judged_effect.name, judged_effect.where)}
    training_test = _TieTest(
        train_data,
        _removed_energy(winner, alternative),
        winner.fit.residual,
        alternative.fit.residual,
    )
    out = []
    assert isinstance(judged_effect, Effect)
    for hypothesis, fresh in hypotheses.replacements(winner, used):
        other = fresh.term
        assert isinstance(other, Effect)
        same_law = of_one_law(judged_effect, other)
        justified = _numbers_justified(winner, hypothesis)
        alike = training_test.ties(hypothesis.fit.residual, TRACE.tie_ratio_training)
        if (
            not (justified or alike)
            or (same_law and hypothesis.size <= winner.size)
            or hypotheses.physical_problem(hypothesis, may_be_at_bounds=others)
            or _disturbed_equations(hypotheses, hypothesis, alternative)
        ):
            continue
        rival_residual = held_out_residual(holdout_data, hypothesis.fit)
        if _is_refused_simpler_name(
            hypotheses, holdout_data, (judged_effect, other), others, rival_residual
        ):
            continue
        ratio = held_out_test.ratio(rival_residual)
        tied = held_out_test.ties(rival_residual, TRACE.tie_ratio) and (
            alike or ratio < TRACE.decisive_ratio
        )
        own = judged_effect.family if same_law else ""
        moved = _moved_parameter(train_data, winner, hypothesis, own) if tied else None
        # However many numbers it has: a free form has no parameters to compare.
        free = any(u.term.free for u in hypothesis.effects)  # type: ignore[attr-defined]
        if (same_law and moved is None) or (not justified and (moved is None or free)):
            continue
        out.append(
            Rival(
                other.name,
                _place(other),
                ratio,
                training_test.ratio(hypothesis.fit.residual),
                tied,
                other.where,
                moved,
            )
        )
    out.sort(key=lambda r: (not r.tied, r.ratio))
    return out[: TRACE.most_rivals]


def _numbers_justified(winner: Hypothesis, rival: Hypothesis) -> bool:
    """Return whether each further free number of a rival removes `SEARCH.number_price`."""
    more = rival.size[1] - winner.size[1]
    return more <= 0 or rival.total <= winner.total - SEARCH.number_price * more


def _moved_parameter(
    train_data: RegressionData, winner: Hypothesis, rival: Hypothesis, law: str
) -> tuple[str, float] | None:
    """Return the baseline parameter that a rival changes most, and its relative change.

    It changes by at least `TRACE.noted_shift` and lies outside the rival's 95 % interval: the
    stated intervals would be wrong if the rival were true. None where no parameter does. Those of
    the baseline's term of the same `law` are left out (viscous friction beside dry `friction`,
    whose forms differ by a slope too); '' leaves out none.
    """
    names, covariance = noise_covariance(train_data, rival.fit)
    most: tuple[str, float] | None = None
    rig = train_data.rig
    others = [term for term in baseline_of(rig) if not law or not term.name.endswith(law)]
    for c in (c for term in others for c in term.coefficients(rig)):
        value, other = (h.fit.beta.get(c.parameter, 0.0) for h in (winner, rival))
        if not value or not other or c.parameter not in names:
            continue
        k = names.index(c.parameter)
        std = float(np.sqrt(max(covariance[k, k], 0.0)))
        change = value / other - 1.0 if c.reciprocal else other / value - 1.0
        large = abs(change) > max(TRACE.noted_shift, abs(most[1]) if most else 0.0)
        if large and abs(other - value) > TRACE.normal_quantile * std:
            most = c.parameter, float(change)
    return most


def _composites_in_words(
    hypotheses: HypothesisSet, winner: Hypothesis, used: Used, holdout_data: RegressionData,
    held_out_test: _TieTest,
) -> str:  # fmt: skip
    """Name two effects that together leave as little as one ('' if none do).

    For levels of friction by direction one level and an offset torque differ by the lever arm only.
    They make no rival, since one effect is the simpler explanation.
    """
    for effects in hypotheses.composites(winner, used):
        both = hypotheses.refined(effects)
        if hypotheses.physical_problem(both):
            continue
        residual = held_out_residual(holdout_data, both.fit)
        if held_out_test.ties(residual, TRACE.tie_ratio):
            names = " and ".join(u.term.name for u in effects[-2:])
            ratio = held_out_test.ratio(residual)
            return f"; {names} together would leave {ratio:.2f} times the held-out rms"
    return ""


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


class _TieTest:
    """Comparison of other fits with the best one, in the equations in which an effect acts.

    `left` (M,) is the whitened residual of the best fit, `without` (M,) that without the effect.
    """

    def __init__(
        self, data: RegressionData, equations: Collection[str], left: Array, without: Array
    ) -> None:
        self.rows = np.zeros(len(left), dtype=bool)
        for s in data.segments:
            self.rows[s.where] = s.equation in equations
        self.left = left[self.rows]
        self.energy = float(self.left @ self.left)
        self.taken = float(without[self.rows] @ without[self.rows]) - self.energy

    def ratio(self, other: Array) -> float:
        """Return the residual rms of another fit (M,) over that of the best."""
        energy = float(other[self.rows] @ other[self.rows])
        return float(np.sqrt(energy / self.energy)) if self.energy > 0 else float("nan")

    def ties(self, other: Array, tie: float) -> bool:
        """Return whether another fit (M,) has less than `tie` times the rms, or loses only noise.

        For an effect that removes less energy than remains, the ratio is of the removed energy.
        """
        change = other[self.rows] - self.left
        lost = float(change @ (other[self.rows] + self.left))
        share = (tie**2 - 1.0) * min(self.energy, max(self.taken, 0.0))
        return (
            lost < share or loss_in_deviations(other[self.rows], self.left) <= TRACE.standard_errors
        )


def _differences_in_words(differing: Sequence[Difference]) -> str:
    if not differing:
        return "the same in every step, half, direction and speed"
    return "; ".join(
        f"{d.parameter} = {with_interval(d.value, d.error)} in {d.part}" for d in differing[:3]
    )


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
