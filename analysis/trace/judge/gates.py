"""Gates: the conditions that an effect must meet to be named.

Significance is not enough, since a model error makes every correlated candidate significant. Only
the cause reduces the error of records with another excitation, has a physically possible size, the
same in all parts of the records, and fits better than any other effect.

Where the verdict is `unexplained`, the unknown cause may resemble an effect that does not act:
effects beside it must meet further conditions (`judged_beside_unknown_cause`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shapes_of
from analysis.regression.least_squares import shortest
from analysis.terms.base import Used, family_of
from analysis.trace.data.candidates import at_start, effect_in, effects_among
from analysis.trace.data.conditioned_record import families_of
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge import held_out, inference, rivals
from analysis.trace.judge.curves import curves_of
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.inference import all_include
from analysis.trace.judge.invariance import Difference, invariance
from analysis.trace.judge.rivals import rivals_in_words
from analysis.trace.judge.scatter import form_shift
from analysis.trace.result import Gate, JudgedEffect, Rival
from analysis.trace.search.exact_fit import ExactFit, design_matrix, jacobian
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    effect_of,
    energy_above_noise,
    of_one_law,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.rig import Rig
from rig.model.units import plain, with_interval

Array = NDArray[np.float64]


REMOVES, PHYSICAL, INVARIANT, SIGNIFICANT, NO_RIVAL, FREE_RUN, BESIDE_UNKNOWN = (
    "removes on held-out", "physical", "invariant", "significant", "no rival", "free run",
    "beside an unknown cause",
)  # fmt: skip
ZERO_IN_INTERVAL = ", but its size may be zero: another effect there shares its force or flow"


def passes_gates(effect: JudgedEffect) -> bool:
    """Return whether an effect passes every gate but that of rivals, which makes it confounded."""
    return all(gate.ok for gate in effect.gates if gate.name != NO_RIVAL)


def passes_but_beside_unknown_cause(effect: JudgedEffect) -> bool:
    """Return whether nothing but an unknown cause keeps an effect from being named."""
    return all(gate.ok for gate in effect.gates if gate.name not in (NO_RIVAL, BESIDE_UNKNOWN))


def removes(effect: JudgedEffect) -> bool:
    """Return whether an effect passes the gate of removed held-out energy."""
    return any(gate.ok for gate in effect.gates if gate.name == REMOVES)


def refused_effects(effects: Sequence[JudgedEffect]) -> tuple[JudgedEffect, ...]:
    """Return the effects that fail a gate, each once, those that remove most first.

    An effect that passes the gates in one of its judgements is left out.
    """
    once: dict[Key, JudgedEffect] = {}
    for effect in sorted(effects, key=_rank):
        once.setdefault((effect.name, effect.at or effect.where), effect)
    return tuple(f for f in once.values() if not passes_gates(f))


def _rank(effect: JudgedEffect) -> tuple[bool, float, float]:
    """Return the key that sorts passing effects first, then those that remove most energy.

    That is the mean square removed from whitened held-out rows; shares of what different sets leave
    do not compare, and decide where there are no rows.
    """
    removed = effect.rms_without**2 - effect.rms_with**2
    energy = removed if np.isfinite(removed) else 0.0
    return not passes_gates(effect), -energy, -effect.removed_fraction


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
    null_energies = inference.null_maximum(
        hypotheses.candidates, train_data, _noise_samples(train_data, winner.fit.residual), rng
    )
    before, after = (held_out_residual(holdout_data, o.fit) for o in (hypotheses.empty, winner))
    shift = form_shift(train_data, winner.fit)
    alternatives = hypotheses.each(
        lambda sets, used: _set_without(sets, winner, used), winner.effects
    )
    out = []
    for used, alternative in zip(winner.effects, alternatives, strict=True):
        effect = effect_in(used)
        without = held_out_residual(holdout_data, alternative.fit)
        changes = held_out.removed_energy(winner, alternative)
        tie_test = rivals.TieTest(holdout_data, changes, after, without)
        pairs, others = [], []
        if changes:  # an effect that removes nothing leaves no equation to compare others in
            _fit_alike_together(hypotheses, winner, used)
            pairs = rivals.tied_pairs(hypotheses, winner, used, tie_test)
            others = rivals.rivals_of(hypotheses, winner, used, alternative, tie_test, pairs)
        removed = held_out.removal_of(holdout_data, changes, without, after)
        disturbed = {
            *held_out.disturbed_equations(hypotheses, winner, alternative),
            *held_out.disturbed_in_held_out(holdout_data, before, without, after),
        }
        p = inference.p_value(alternative.fit.energy - winner.fit.energy, null_energies)
        effect_errors = inference.effect_errors(train_data, winner.fit, used)
        estimates = inference.estimates(train_data, used, effect_errors, shift)
        unknown_size = inference.is_of_unknown_size(train_data.rig, used, estimates, winner.effects)
        differing = invariance(train_data, winner.fit, used, effect_errors)
        unphysical = hypotheses.physical_problem(winner, used)
        inseparable = [
            Rival(name, effect_of(name, at).place, 1.0, 1.0, True, at)
            for name, at in effect.inseparable_beside(
                train_data.rig, used.shape, winner.without(used)
            )
        ]
        removes = removed.share >= TRACE.least_removed and not disturbed
        significance = f"family-wise p = {p:.3g}" + (ZERO_IN_INTERVAL if unknown_size else "")
        rival_words = (
            rivals.rivals_in_words([*inseparable, *others])
            if changes
            else "it removes nothing that another effect could remove"
        )
        separated = not (inseparable or any(r.tied for r in others))
        if separated:
            rival_words += rivals.pair_in_words(pairs)
        gates = (
            Gate(REMOVES, removes, held_out.removal_in_words(removed, disturbed)),
            Gate(PHYSICAL, not unphysical, unphysical or "sign and size are possible"),
            Gate(INVARIANT, not differing, _differences_in_words(differing)),
            Gate(SIGNIFICANT, p <= TRACE.p_limit and not unknown_size, significance),
            Gate(NO_RIVAL, separated, rival_words),
        )
        out.append(
            JudgedEffect(
                effect.name, effect.place,
                {n: e for n, e in estimates.items() if n not in train_data.beta},
                p, removed.share, (*inseparable, *others), gates,
                effect.variable_on(train_data.rig),
                mechanism=effect.mechanism, free=effect.free, at=effect.where,
                curves=curves_of(train_data, winner.fit, used),
                rms_without=held_out.rms_in(holdout_data, without, changes),
                rms_with=held_out.rms_in(holdout_data, after, changes),
            )
        )  # fmt: skip
    return tuple(out)


def _fit_alike_together(hypotheses: HypothesisSet, winner: Hypothesis, used: Used) -> None:
    """Fit the set with two effects that together act alike in place of one, if it is not yet."""
    rig, others = hypotheses.train_data.rig, winner.without(used)
    pair = effect_in(used).alike_together(rig)
    if pair and not winner.keys & set(pair):
        hypotheses.refined([*others, *(at_start(rig, effect_of(*key)) for key in pair)], winner)


def _set_without(hypotheses: HypothesisSet, winner: Hypothesis, used: Used) -> Hypothesis:
    """Return the set without one effect and its other readings, as the alternative to the effect.

    An unphysical set is no alternative (two levels of friction of opposite signs make a torque
    offset): then the best physical set of the other effects or readings of them is returned. Two
    readings of one law are removed together, since `readings` decides whether both are needed.
    """
    law = effect_in(used)
    others = [u for u in winner.without(used) if not of_one_law(effect_in(u), law)]
    without = hypotheses.refined(others)
    rig = hypotheses.train_data.rig
    # A shape at its bound is an error of the form, not of physics.
    at_bound = any(effect_in(u).outside(rig, u.shape) for u in without.effects)
    if at_bound or not hypotheses.physical_problem(without):
        return without

    def is_kept(effect: Effect) -> bool:
        """Return whether an effect is one of `others` or a reading of one."""
        return any(effect == other or of_one_law(effect, other) for other in effects_among(others))

    physical = [o for o in hypotheses.fitted.values() if not hypotheses.physical_problem(o)]
    of_kept = [o for o in physical if all(map(is_kept, effects_among(o.effects)))]
    return min([hypotheses.empty, *of_kept], key=lambda o: o.total)


def equations_above_band(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> list[tuple[str, str]]:
    """Return the equations above the band, with the remaining energy and its records in words.

    Held-out records judge a set of effects (`held_out_above_band`); without any effect, training
    records must hold no more than noise either (`HypothesisSet.negligible`).
    """
    band = hypotheses.noise_band
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
    """Return the equations above the band in held-out rows, and their error in words.

    The band is an rms of `TRACE.held_out_band` noise floors or, where an effect has a form that may
    miss (`Effect.exact`), `TRACE.held_out_share` of the energy above noise that the model `before`
    leaves, whichever is larger.
    """
    residual = held_out_residual(holdout_data, after)
    energy_before = energy_above_noise(holdout_data, held_out_residual(holdout_data, before))
    energy_after = energy_above_noise(holdout_data, residual)
    return [
        (e, f"held-out error {r:.2f} times the noise floor")
        for e, r in held_out.error_over_floor(holdout_data, residual).items()
        if r > TRACE.held_out_band
        and energy_after[e]
        > form_share(holdout_data.rig, effects_among(after.terms), e) * energy_before[e]
    ]


def form_share(rig: Rig, effects: Sequence[Effect], equation: str) -> float:
    """Return the share of an equation's energy above noise that the forms of effects may miss.

    It is 0 where all effects that act in its family of equations are exact.
    """
    inexact = [e for e in effects if not e.exact and family_of(equation) in families_of(rig, e)]
    return TRACE.held_out_share if inexact or not effects else 0.0


def _noise_samples(train_data: RegressionData, residual: Array) -> Array:
    """Return samples (R, M) of the noise: the repeats' residuals without their mean.

    They are scaled to the full noise. A step with one repeat has the `residual` (M,) of the winner.
    """
    out = train_data.residual.copy()
    for s in train_data.segments:
        if s.repeats > 1:
            repeats = out[: s.repeats, s.where]
            scale = np.sqrt(s.repeats / (s.repeats - 1))
            out[: s.repeats, s.where] = (repeats - repeats.mean(axis=0)) * scale
        else:
            out[0, s.where] = residual[s.where]
    return out


def _differences_in_words(differing: Sequence[Difference]) -> str:
    if not differing:
        return "the same in every step, half, direction and speed"
    return "; ".join(
        f"{d.parameter} = {with_interval(d.value, d.error)} in {d.part}" for d in differing[:3]
    )


def judged_beside_unknown_cause(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    effects: Sequence[JudgedEffect],
    unexplained: Collection[str],
) -> tuple[JudgedEffect, ...]:
    """Return the effects of the set `winner` after the further gates beside an unknown cause.

    `unexplained` are the equations above the band. An effect is refused that removes less than
    `TRACE.least_removed_beside` of the energy in its own equations, that the other equations alone
    do not show, or whose size may be zero. Rivals that held-out records alone do not separate from
    an effect are tied.
    """
    data = hypotheses.train_data
    rows = ~data.in_equations(unexplained)
    energy_outside = _energy(data, winner, rows)

    def problem(group: Sequence[Used]) -> str:
        """Return in words why effects that act together are not named ('' if they are)."""
        without = hypotheses.refined([u for u in winner.effects if u not in group])
        columns = [jacobian(data, winner.fit, used_by_key)[1] for used_by_key in group]
        # Sorted: the order of a sum decides its last digit.
        acting = sorted(
            {s.equation for s in data.segments if any(np.any(J[s.where]) for J in columns)}
        )
        removed = {e: without.excess_energy[e] - winner.excess_energy[e] for e in acting}
        share = sum(removed.values()) / max(1e-30, sum(without.excess_energy[e] for e in acting))
        if share < TRACE.least_removed_beside:
            return (
                f"{100 * max(0.0, share):.0f} % of the repeatable energy of "
                f"{', '.join(acting)}, too little beside a cause that is not known"
            )
        removed_outside = sum(v for e, v in removed.items() if e not in unexplained)
        gain_outside = _energy(data, without, rows) - energy_outside
        mostly_outside = removed_outside > TRACE.least_removed * sum(removed.values())
        if mostly_outside and gain_outside < TRACE.least_removed * removed_outside:
            return (
                f"nothing where {', '.join(sorted(unexplained))} are left out of the fit: they "
                "bend a parameter that the other equations share"
            )
        return ""

    # Two effects that together compensate one biased parameter seem needed beside each other.
    together = problem(winner.effects) if len(winner.effects) > 1 else ""
    used_by_key = {u.term.key: u for u in winner.effects}

    def refused(effect: JudgedEffect) -> JudgedEffect:
        used = used_by_key[effect.name, effect.at]
        why = together or problem([used]) or _size_includes_zero(data.rig, used, effect)
        tied = tied_in_held_out(effect)
        gate = Gate(BESIDE_UNKNOWN, not why, why or "the equations that are explained show it too")
        return replace(tied, gates=(*tied.gates, gate))

    return tuple(map(refused, effects))


def _size_includes_zero(rig: Rig, used: Used, effect: JudgedEffect) -> str:
    """Return in words that the intervals of all sizes include no effect ('' if one does not).

    A size is a coefficient, or a shape with a value at which the effect vanishes. What an unknown
    cause leaves widens the intervals.
    """
    sizes = {c.parameter: 0.0 for c in used.term.coefficients(rig)}
    sizes |= {s.parameter: s.neutral for s in shapes_of(rig, used) if s.neutral is not None}
    if effect_in(used).free or not all_include(sizes, effect.parameters):
        return ""
    names = ", ".join(name for name in sizes if name in effect.parameters)
    return f"{names} may be nothing within the interval beside a cause that is not known"


def _energy(data: RegressionData, hypothesis: Hypothesis, rows: NDArray[np.bool_]) -> float:
    """Return the energy that a set leaves in `rows` (a mask) with coefficients fitted to these."""
    design = design_matrix(data, hypothesis.fit.terms)
    X, y = design.matrix[rows], design.rhs[rows]
    residual = y - X @ shortest(X, y, TRACE.rank_limit)
    return float(residual @ residual)


def tied_in_held_out(effect: JudgedEffect) -> JudgedEffect:
    """Return an effect with every rival tied that held-out records alone do not separate from it.

    With an unknown cause in the training records, their residuals are no evidence.
    """
    return with_rivals(
        effect, [replace(r, tied=r.tied or r.ratio < TRACE.tie_ratio) for r in effect.rivals]
    )


def with_rivals(effect: JudgedEffect, rivals: Sequence[Rival]) -> JudgedEffect:
    """Return an effect with these rivals, tied ones first; any of them fails its gate."""
    rivals = sorted(rivals, key=lambda r: not r.tied)
    if not any(r.tied for r in rivals):
        return effect
    other_gates = [gate for gate in effect.gates if gate.name != NO_RIVAL]
    gate = Gate(NO_RIVAL, False, rivals_in_words(rivals))
    return replace(effect, rivals=tuple(rivals), gates=(*other_gates, gate))
