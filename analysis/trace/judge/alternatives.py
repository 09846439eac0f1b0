"""Alternatives: other sets that could hold in place of the named one; they widen its intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from analysis.simulation.model import Model
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.readings import loss_in_deviations
from analysis.trace.judge.rivals import law_parameters, moved_parameter, tied_sets
from analysis.trace.judge.scatter import fitted_shapes
from analysis.trace.result import JudgedEffect
from analysis.trace.search.extensions import with_parts_beside
from analysis.trace.search.hypothesis import Hypothesis, is_special_case, of_one_law
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.rig import Rig


def alternatives_of(
    hypotheses: HypothesisSet, winner: Hypothesis, effects: Sequence[JudgedEffect],
    holdout_data: RegressionData,
) -> list[tuple[Hypothesis, str]]:  # fmt: skip
    """Return the sets that could hold in place of the winner, and the law that each leaves out.

    They are those with a tied rival; those with a richer form of a named effect, such as two levels
    of friction for one, that move parameters too little to be rivals; those with another effect of
    more numbers that fits as well; and those with another part of its law beside it, such as a
    level beside a breakaway. Most leave out none (''). A richer form that is not possible (its
    levels are equal) leaves out its law's term of the baseline, viscous friction: forms of friction
    differ by a slope too.
    """
    tied = tied_sets(hypotheses, winner, effects)
    out = [(hypothesis, "") for hypothesis in tied]
    named = {(effect.name, effect.at) for effect in effects}
    for used in winner.effects:
        effect = effect_in(used)
        if effect.key not in named:
            continue
        equal = _equal_with_more_numbers(hypotheses, winner, used, holdout_data)
        out += [(hypothesis, "") for hypothesis in equal if hypothesis not in tied]
        for form in hypotheses.effects:
            if not is_special_case(effect, form) or form.key in winner.keys:
                continue
            rows, law = hypotheses.train_data, effect.family
            richer = hypotheses.refined([*winner.without(used), at_start(rows.rig, form)])
            if richer not in tied and moved_parameter(rows, winner, richer, law) is None:
                possible = not hypotheses.physical_problem(richer)
                out.append((richer, "" if possible else law))
    for parts in map(hypotheses.refined, with_parts_beside(hypotheses, winner)):
        if not hypotheses.physical_problem(parts):
            out.append((parts, ""))
    return out


def _equal_with_more_numbers(
    hypotheses: HypothesisSet, winner: Hypothesis, used: Used, holdout_data: RegressionData
) -> Iterator[Hypothesis]:
    """Yield the sets with an effect of more numbers in the place of `used` that lose only noise.

    Over a short arc a spring fits as well as an inclination, with another weight.
    """
    best = held_out_residual(holdout_data, winner.fit)
    for hypothesis, (rival,) in hypotheses.replacements(winner, used):
        other = effect_in(rival)
        richer = hypothesis.size[0] == winner.size[0] and hypothesis.size[1] > winner.size[1]
        if not richer or other.free or of_one_law(effect_in(used), other):
            continue
        residual = held_out_residual(holdout_data, hypothesis.fit)
        losses = (
            loss_in_deviations(hypothesis.fit.residual, winner.fit.residual),
            loss_in_deviations(residual, best),
        )
        if max(losses) <= TRACE.standard_errors and not hypotheses.physical_problem(hypothesis):
            yield hypothesis


def errors_by_alternatives(
    model: Model, alternatives: Sequence[tuple[Model, str]]
) -> dict[str, float]:
    """Return the further standard error of parameters by other models of the records, by name.

    Each alternative, identified as the model is, counts with the same weight: the square of the
    error is the mean, over the model and them, of the squared shift and of the variance beyond the
    model's (Buckland, Burnham and Augustin, Biometrics 53, 1997). Parameters of the baseline's term
    of the law that an alternative leaves out are not compared with it.
    """
    compared = [(other.parameters, law_parameters(model.rig, law)) for other, law in alternatives]
    errors = {}
    for name, estimate in model.parameters.items():
        others = [found[name] for found, out in compared if name in found and name not in out]
        added_variance = sum(
            (o.value - estimate.value) ** 2 + max(o.std**2 - estimate.std**2, 0.0)
            for o in others if o.identified
        )  # fmt: skip
        if estimate.identified and added_variance > 0.0:
            errors[name] = math.sqrt(added_variance / (len(alternatives) + 1))
    return errors


def shape_errors_by_alternatives(
    rig: Rig, winner: Hypothesis, alternatives: Sequence[Hypothesis]
) -> dict[str, float]:
    """Return the further standard error of the winner's shapes by other sets, by name.

    It is the root of the mean square of the shifts, as in `errors_by_alternatives`. Sets without
    the shape count with none.
    """
    others = [fitted_shapes(rig, other.fit) for other in alternatives]
    errors = {}
    for name, value in fitted_shapes(rig, winner.fit).items():
        squares = sum((shapes.get(name, value) - value) ** 2 for shapes in others)
        if squares > 0.0:
            errors[name] = math.sqrt(squares / (len(others) + 1))
    return errors
