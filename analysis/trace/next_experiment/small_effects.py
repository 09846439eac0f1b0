"""Effects too small to be named that change a parameter: they widen its interval and are noted.

An effect may leave less in the residual than counts as something to explain, and yet far more than
noise alone gives along its own direction: a base inclined by 0.03 rad left 1.02 times the noise and
changed a weight by 3 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.readings import loses_by_restriction
from analysis.trace.judge.rivals import moved_parameter
from analysis.trace.next_experiment.detection_limits import AbsorbedEffects
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE
from rig.model.channels import place_in_words
from rig.model.units import plain

Moved = tuple[str, float]


def sets_with_small_effect(
    hypotheses: HypothesisSet, absorbed: AbsorbedEffects | None, winner: Hypothesis,
    holdout_data: RegressionData,
) -> list[tuple[Hypothesis, Moved]]:  # fmt: skip
    """Return the sets with the further effect that training and held-out rows show most clearly.

    Each is returned with the parameter that it moves most, and its relative change.

    There are several where one effect fits as well as another. The effect is one of `absorbed`,
    exceeds `TRACE.suggested_deviations` of its noise, to first order and fitted, is possible,
    reduces the held-out residual by more than noise and changes a parameter by more than its
    interval.
    """
    if absorbed is None:
        return []
    left, found = held_out_residual(holdout_data, winner.fit), []
    for effects in _clearest(absorbed, winner):
        larger = hypotheses.refined([*winner.effects, *effects])
        if (
            winner.fit.energy - larger.fit.energy > TRACE.suggested_deviations**2
            and not hypotheses.physical_problem(larger)
            and loses_by_restriction(left, held_out_residual(holdout_data, larger.fit))
            and (moved := moved_parameter(hypotheses.train_data, winner, larger, least=0.0))
        ):
            found.append((larger, moved))
    least = min((o.fit.energy for o, _ in found), default=0.0)
    return [(o, moved) for o, moved in found if o.fit.energy <= least + SEARCH.number_price]


def _clearest(absorbed: AbsorbedEffects, winner: Hypothesis) -> list[tuple[Used, ...]]:
    """Return what exceeds its noise most, in units of its standard deviation.

    Effects at both chambers come after single ones, so that none of these is left out for them.
    """
    size = np.linalg.norm(absorbed.shown, axis=0)
    along = np.abs(absorbed.shown.T @ winner.fit.residual)
    deviations = np.divide(along, size, out=np.zeros_like(along), where=size > 0)
    order = [k for k in np.argsort(-deviations) if deviations[k] > TRACE.suggested_deviations]
    effects = [absorbed.explanations[k].effects for k in order]
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
