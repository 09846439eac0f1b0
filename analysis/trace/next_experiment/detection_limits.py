"""Detection limits: the largest size of an effect that leaves no residual above the noise.

With the whitened rows X of the model in use, an effect at its smallest size of interest adds y to
them. Least squares absorbs the part X d of y, d = X^+ y, into the parameters; only q = y - X d
remains in the residual. A residual r then gives the effect's size as q'r / q'q with the standard
error 1 / |q| (in units of the smallest size), and the largest size that agrees with the records is

    L = |q'r| / q'q + z / |q|,  z the normal quantile of 95 %.

An effect of this size would have changed the parameters by L d without a visible residual
(omitted-variable bias; e.g. Greene, Econometric Analysis, section 4.3).

An effect may leave less in the residual than counts as something to explain, and yet far more than
noise alone gives along its own direction: a base inclined by 0.03 rad left 1.02 times the noise and
changed a weight by 3 %. It is not named, but widens the intervals of parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values, shapes_of
from analysis.identify.settings import IDENTIFY
from analysis.regression.least_squares import shortest
from analysis.simulation.model import Model
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in, effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.readings import loses_by_restriction
from analysis.trace.judge.rivals import moved_parameter
from analysis.trace.next_experiment.discrimination import (
    ComparisonRows,
    Explanation,
    smallest_effect,
)
from analysis.trace.result import DetectionLimit
from analysis.trace.search.exact_fit import parameter_values, rebased, tangent
from analysis.trace.search.hypothesis import Hypothesis, is_special_case, law_of
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE
from rig.model.channels import place_in_words
from rig.model.rig import Rig
from rig.model.units import plain, typeset

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AbsorbedEffects:
    """Further effects at their smallest sizes of interest, beside a set.

    Of what each adds to the whitened rows of `data`, `residual` (M, n) remains; the rest is
    absorbed by `shifts` (k, n) of the coefficients and shapes `names` of the set.
    """

    data: RegressionData
    explanations: Sequence[Explanation]
    names: Sequence[str]
    shifts: Array
    residual: Array


def absorbed_effects(
    hypotheses: HypothesisSet, effects: Sequence[Effect], winner: Hypothesis
) -> AbsorbedEffects | None:
    """Return what further effects among the candidates `effects` would add, None if there are none.

    Another name of a law that acts in the set has the shape with which it was fitted in place of
    that name. Special cases of effects of the set are left out, and all effects beside a free form,
    since its curve absorbs similar ones. Rows of a joint in motion limit no breakaway.
    """
    train_data = hypotheses.train_data
    in_motion = train_data.records[0].filtering.in_motion
    named = effects_among(winner.effects)
    if any(effect.free for effect in named):
        return None
    rows = ComparisonRows(rebased(train_data, winner.fit) if winner.effects else train_data)
    further = [
        effect for effect in effects
        if effect.key not in winner.keys
        and not (effect.beside and effect.joint in in_motion)
        and not any(is_special_case(effect, rival) for rival in named)
    ]  # fmt: skip
    shape_by_effect = {
        effect_in(rival): rival.shape
        for member in winner.effects for _, (rival,) in hypotheses.replacements(winner, member)
        if law_of(effect_in(rival)) == law_of(effect_in(member))
    }  # fmt: skip
    explanations = (smallest_effect(e, train_data.rig, shape_by_effect.get(e, ())) for e in further)
    small = [explanation for explanation in explanations if explanation is not None]
    if not small:
        return None
    names, X = tangent(train_data, winner.fit)
    added = np.column_stack([rows.prediction(explanation) for explanation in small])
    pairs = _pairs_of_chambers(small)
    both = [
        Explanation(small[cap].effects + small[rod].effects, {**small[cap].beta, **small[rod].beta})
        for cap, rod in pairs
    ]
    added = np.column_stack((added, *(added[:, [cap, rod]].sum(axis=1) for cap, rod in pairs)))
    taken = shortest(X, added, TRACE.rank_limit)
    return AbsorbedEffects(rows.train_data, [*small, *both], names, taken, added - X @ taken)


def _pairs_of_chambers(single: Sequence[Explanation]) -> list[tuple[int, int]]:
    """Return index pairs in `single` of an effect at the cap side and at the rod side of a joint.

    Both chambers' pressures read against vacuum, or both pipes longer than stated, are as likely as
    one alone, and the parameters may absorb more of the two.
    """
    at = {e.effects[0].term.key: k for k, e in enumerate(single)}
    return [
        (k, at[name, where.removesuffix("cap") + "rod"])
        for (name, where), k in at.items()
        if where.endswith(" cap") and (name, where.removesuffix("cap") + "rod") in at
    ]


def detection_limits(
    absorbed: AbsorbedEffects | None, winner: Hypothesis, model: Model
) -> list[DetectionLimit]:
    """Return the limits of effects that would change a parameter visibly, largest change first.

    `absorbed` are the further effects; each name is returned once, at the place where it changes
    most. `winner` is the set found and `model` the model identified with it. No effect is larger
    than what changes a parameter by all of its value.
    """
    if absorbed is None:
        return []
    data, residual = absorbed.data, winner.fit.residual
    half_widths = {n: p.half for n, p in model.parameters.items() if abs(p.value) > 2.0 * p.half}
    limits = []
    for k, explanation in enumerate(absorbed.explanations):
        shown = absorbed.residual[:, k]
        energy, factor = float(shown @ shown), 0.0
        if energy > 0.0:  # else nothing remains in the residual, and no size can be stated
            most_noise = IDENTIFY.normal_quantile * energy**0.5
            factor = float((abs(shown @ residual) + most_noise) / energy)
        changes = dict(zip(absorbed.names, factor * absorbed.shifts[:, k], strict=True))
        shifts = _parameter_shifts(data, changes, half_widths)
        most = max(shifts, key=lambda name: shifts[name], default="")
        if most and shifts[most] > 1.0:  # the parameter would be 0 or of the other sign
            factor, shifts = factor / shifts[most], {most: 1.0}
        if most and shifts[most] >= TRACE.noted_shift:
            size = _effect_size(data, explanation, factor)
            possible = is_possible(data.rig, model, explanation, factor)
            place = _reported_places(explanation)
            limits.append(
                DetectionLimit(
                    explanation.keys[0]["name"], *place, *size, most, shifts[most], possible
                )
            )  # fmt: skip
    by_name: dict[str, DetectionLimit] = {}
    for limit in sorted(limits, key=lambda f: -f.shift):
        by_name.setdefault(limit.name, limit)
    return list(by_name.values())


def _reported_places(explanation: Explanation) -> tuple[str, str]:
    """Return the place of an effect as reported, and as the catalogue has it."""
    first, *others = explanation.keys
    if not others:
        return first["where"], first["at"]
    both = f"{first['at'].removesuffix('cap')}both chambers"
    return both, both


def _parameter_shifts(
    data: RegressionData, changes: Mapping[str, float], half_widths: Mapping[str, float]
) -> dict[str, float]:
    """Return the relative change of the parameters that change by more than their interval.

    `changes` are those of the rows' coefficients and of shapes, `half_widths` those of the
    intervals, by name.
    """
    shapes = {n: v for u in data.terms for n, v in shape_values(data.rig, u).items()}
    before = {**data.beta, **shapes}
    after = {n: v + changes.get(n, 0.0) for n, v in before.items()}
    values_before, values_after = (
        {**{n: b[n] for n in shapes}, **parameter_values(data.rig, data.terms, b)}
        for b in (before, after)
    )
    return {
        name: abs(values_after[name] / values_before[name] - 1.0)
        for name, half in half_widths.items()
        if values_before.get(name) and abs(values_after[name] - values_before[name]) > half
    }


def _effect_size(
    data: RegressionData, explanation: Explanation, factor: float
) -> tuple[str, float, str, float]:
    """Return name, size, unit and neutral value of the number that states an effect's size.

    The size is the difference from the neutral value, 1 of a gain.
    """
    used = explanation.effects[0]
    for c in used.term.coefficients(data.rig):
        if explanation.beta.get(c.parameter):
            return c.parameter, abs(explanation.beta[c.parameter]) * factor, c.unit, 0.0
    shapes = shapes_of(data.rig, used)
    k = next(k for k, s in enumerate(shapes) if used.shape[k] != (s.neutral or 0.0))
    neutral = shapes[k].neutral or 0.0
    return shapes[k].parameter, abs(used.shape[k] - neutral) * factor, shapes[k].unit, neutral


def is_possible(rig: Rig, model: Model, explanation: Explanation, factor: float) -> bool:
    """Return whether effects physical at their smallest size are so at `factor` times it."""
    known = {name: e.value for name, e in model.parameters.items() if e.identified}

    def problem(used: Used, factor: float) -> str:
        effect, shape = effect_in(used), list(used.shape)
        for k, s in enumerate(shapes_of(rig, used)[: len(effect.shape_of_smallest_size())]):
            neutral = s.neutral or 0.0
            shape[k] = neutral + factor * (shape[k] - neutral)
        values = known | {name: factor * value for name, value in explanation.beta.items()}
        return effect.problem(rig, values, shape)

    return all(not problem(u, factor) or bool(problem(u, 1.0)) for u in explanation.effects)


def detection_limit_notes(limits: Sequence[DetectionLimit]) -> list[str]:
    """Return a sentence for the largest limit of each parameter, then for other large ones.

    `limits` begin with the largest. `TRACE.most_detection_limits` are stated.
    """
    by_parameter: dict[str, DetectionLimit] = {}
    for limit in limits:
        by_parameter.setdefault(limit.parameter, limit)
    stated = list(dict.fromkeys((*by_parameter.values(), *limits)))
    return [
        f"not excluded by these records: {d.name} at {place_in_words(d.at)} {_limit_in_words(d)} "
        "without a residual above the noise"
        for d in stated[: TRACE.most_detection_limits]
    ]


def _limit_in_words(limit: DetectionLimit) -> str:
    if not limit.possible:
        return f"of any possible size, which would change {limit.parameter}"
    size = f"{plain(limit.size, 2)} {typeset(limit.unit)}".strip()
    if limit.neutral:
        size = f"{limit.neutral:g} ± {size}"
    return (
        f"up to {limit.quantity} = {size}, which would change {limit.parameter} by "
        f"{plain(100 * limit.shift, 2)} %"
    )


Moved = tuple[str, float]


def sets_with_small_effect(
    hypotheses: HypothesisSet, absorbed: AbsorbedEffects | None, winner: Hypothesis,
    holdout_data: RegressionData,
) -> list[tuple[Hypothesis, Moved]]:  # fmt: skip
    """Return the sets with the further effect that training and held-out rows show most clearly.

    Each is returned with the parameter that it moves most, and its relative change.

    There are several where one effect fits as well as another. The effect is one of `absorbed`,
    exceeds `TRACE.suggested_deviations` of its noise, to first order and fitted, is possible,
    reduces the held-out residual by more than noise does in 95 % of records and changes a
    parameter by more than its interval.
    """
    if absorbed is None:
        return []
    data, larger_sets = hypotheses.train_data, list[tuple[Hypothesis, Moved]]()
    residual = held_out_residual(holdout_data, winner.fit)
    for effects in _clearest_effects(absorbed, winner):
        larger = hypotheses.refined([*winner.effects, *effects])
        if (
            winner.fit.energy - larger.fit.energy > TRACE.suggested_deviations**2
            and not hypotheses.physical_problem(larger)
            and loses_by_restriction(
                residual, held_out_residual(holdout_data, larger.fit), IDENTIFY.normal_quantile
            )
            and (moved := moved_parameter(data, winner, larger, least=0.0, with_open=False))
        ):
            larger_sets.append((larger, moved))
    least = min((o.fit.energy for o, _ in larger_sets), default=0.0)
    return [(o, moved) for o, moved in larger_sets if o.fit.energy <= least + SEARCH.number_price]


def _clearest_effects(absorbed: AbsorbedEffects, winner: Hypothesis) -> list[tuple[Used, ...]]:
    """Return the effects that exceed their noise by most standard deviations.

    Effects at both chambers are counted apart from single ones, so that they displace none.
    """
    size = np.linalg.norm(absorbed.residual, axis=0)
    product = np.abs(absorbed.residual.T @ winner.fit.residual)
    deviations = np.divide(product, size, out=np.zeros_like(product), where=size > 0)
    clear = [k for k in np.argsort(-deviations) if deviations[k] > TRACE.suggested_deviations]
    effects = [absorbed.explanations[k].effects for k in clear]
    single, both = ([e for e in effects if len(e) == count] for count in (1, 2))
    return [*single[: TRACE.most_rivals], *both[: TRACE.most_rivals]]


def small_effect_notes(winner: Hypothesis, larger: Sequence[tuple[Hypothesis, Moved]]) -> list[str]:
    """Name the further effects of larger sets that change a parameter by `TRACE.noted_shift`.

    Where none does, the clearest is named: it widens intervals too.
    """
    out = []
    noted = [(o, moved) for o, moved in larger if abs(moved[1]) >= TRACE.noted_shift]
    for hypothesis, (parameter, change) in noted or larger[:1]:
        terms = (u.term for u in hypothesis.effects)
        fresh = [term for term in terms if term.key not in winner.keys]
        places = " and ".join(place_in_words(term.where) for term in fresh)
        out.append(
            f"{fresh[0].name} at {places} leaves too little to be named, but "
            f"the records suggest it or one like it: with it {parameter} would be "
            f"{plain(100 * abs(change), 2)} % {'larger' if change > 0 else 'smaller'}, and its "
            "interval is wider for it"
        )
    return out
