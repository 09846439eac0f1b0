"""Shapes of effects with a hidden state by multiple shooting, and the choice between estimates.

The search starts from the shapes found with the rows (see
`analysis.identify.output_error.hidden_states`). Shapes from shooting are used where the model with
them is closer to held-out records in simulation and the errors of held-out rows do not grow.
Otherwise the shapes from the rows are kept, and the interval of each shape is extended to include
both values: two estimates that differ by more than their errors show that the effect's form is
simpler than the real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from analysis.effects.base import Effect, shape_values
from analysis.identify.output_error.hidden_states import (
    ShootingEstimate,
    completed,
    hidden_effects,
    shot,
    window_error,
)
from analysis.simulation.model import Model
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.held_out import rms_of
from analysis.trace.result import JudgedEffect
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.settings import TRACE
from rig.model.records import Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class ShootingResult:
    """The set with the shapes chosen, and the shapes of every effect by shooting."""

    winner: Hypothesis
    shots: tuple[ShootingEstimate, ...]


def shoot_hidden_states(
    runs: Sequence[Run],
    holdout: Sequence[Run],
    after: Model,
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
) -> ShootingResult:
    """Return the set after multiple shooting of every effect with a hidden state.

    `after` is the identified model of the set `winner`; electric rigs are returned unchanged.
    """
    if after.rig.electric or not hidden_effects(after):
        return ShootingResult(winner, ())
    ready = completed([*runs, *holdout], after)
    if ready is None:
        return ShootingResult(winner, ())
    shots, after = [], ready
    for effect in hidden_effects(after):
        shot_effect = shot(runs, after, effect)
        if shot_effect is None:
            continue
        other = _with_shapes_of(after.rig, after.terms, effect, shot_effect)
        before, now = (
            window_error(holdout, model, effect) for model in (after, replace(after, terms=other))
        )
        fitted = fit_coefficients(
            train_data, _with_shapes_of(after.rig, winner.fit.terms, effect, shot_effect)
        )
        rows, again = (rms_of(holdout_data, fit) for fit in (winner.fit, fitted))
        better = now < TRACE.shooting_ratio * before and all(
            again[e] <= TRACE.shooting_cost * rows[e] for e in rows
        )
        shots.append(
            replace(shot_effect, before=before, after=now, taken=better and shot_effect.settled)
        )
        if shots[-1].taken:
            winner = replace(
                winner, effects=_with_shapes_of(after.rig, winner.effects, effect, shot_effect),
                fit=fitted, excess_energy=energy_above_noise(train_data, fitted.residual),
            )  # fmt: skip
            after = replace(after, terms=other)
    return ShootingResult(winner, tuple(shots))


def _with_shapes_of(
    rig: Rig, terms: Sequence[Used], effect: Effect, shot: ShootingEstimate
) -> tuple[Used, ...]:
    """Return the terms with the shapes from shooting; shapes that it did not search are kept."""
    found = {name: estimate.value for name, estimate in shot.shapes.items()}
    return tuple(
        Used(u.term, tuple({**shape_values(rig, u), **found}.values())) if u.term == effect else u
        for u in terms
    )


def with_shots(judged: JudgedEffect, shots: Sequence[ShootingEstimate]) -> JudgedEffect:
    """Return an effect with the shapes from shooting, or with intervals that include them."""
    for result in shots:
        if (result.name, result.where) == (judged.name, judged.where):
            shapes = dict(result.shapes)
            if not result.taken:
                for name, new in result.shapes.items():
                    rows = judged.parameters[name]
                    low, high = min(rows.ci95[0], new.value), max(rows.ci95[1], new.value)
                    shapes[name] = replace(rows, ci95=(low, high))
            return replace(judged, parameters={**judged.parameters, **shapes}, shot=result)
    return judged
