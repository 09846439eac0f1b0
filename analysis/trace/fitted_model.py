"""The model with the effects that a trace found, and the intervals of its parameters.

Shapes of effects with a hidden state are searched by multiple shooting too, from those found with
the rows (see `analysis.identify.output_error.hidden_states`). They are used where the model with
them is closer to held-out records in simulation and the errors of held-out rows do not grow.
Otherwise the shapes from the rows are kept, and the interval of each shape is extended to include
both values: two estimates that differ by more than their errors show that the effect's form is
simpler than the real one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.effects.base import Effect, ordered, shape_values
from analysis.identify.coupled import coupled
from analysis.identify.estimators.nuisance import BulkTemperature, DrivePath, SpoolPath
from analysis.identify.output_error.hidden_states import (
    ShootingEstimate,
    completed,
    hidden_effects,
    shot,
    window_error,
)
from analysis.identify.result import Identification, reciprocal_interval
from analysis.identify.settings import IDENTIFY
from analysis.regression.rows import Filtering, default_filtering, parameters_of
from analysis.simulation.model import Estimate, Model
from analysis.terms.base import Used, family_of
from analysis.trace.data.nuisance_terms import at_nominal_temperature
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.data.trace_rows import TraceRuns
from analysis.trace.finding import Finding
from analysis.trace.in_motion import equations_above_noise
from analysis.trace.judge.held_out import rms_of
from analysis.trace.judge.inference import with_form_error
from analysis.trace.judge.rivals import alternatives_of, deviations, errors_by_alternatives
from analysis.trace.judge.scatter import form_shift, with_errors, with_form_errors
from analysis.trace.next_experiment.detection_limits import (
    AbsorbedEffects,
    absorbed_effects,
    sets_with_small_effect,
    small_effect_notes,
)
from analysis.trace.notes import shared_parameters
from analysis.trace.result import UNEXPLAINED, JudgedEffect
from analysis.trace.search.exact_fit import contribution, design_matrix, fit_coefficients
from analysis.trace.search.geometry import shape_errors
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.settings import TRACE
from rig.model.records import Record, Run
from rig.model.rig import Rig

# Other estimators replace columns where noise in them matters; the trace compares residuals of
# least squares only, before and after alike.
ESTIMATOR = "ls"


@dataclass(frozen=True)
class FittedModel:
    """The set of effects with the shapes that are used, and the model with them.

    `effects` are those named, with intervals that hold every error; `notes` state what widens
    intervals. `absorbed` are further effects beside the set that was found, unless it explains
    nothing.
    """

    winner: Hypothesis
    model: Model
    effects: tuple[JudgedEffect, ...]
    notes: tuple[str, ...]
    absorbed: AbsorbedEffects | None


def model_with_effects(
    records: TraceRuns,
    choosing_runs: Sequence[Run],
    before: Model,
    candidates: Sequence[Effect],
    finding: Finding,
) -> FittedModel:
    """Identify the model with the effects found, hidden states by multiple shooting.

    `before` is the baseline's model, `choosing_runs` and `candidates` are those of the search.
    """
    runs, rows = records.train, finding.rows
    after, from_tolerances = _identified_with_effects(runs, finding.winner, before, rows)
    winner, shots = shoot_hidden_states(
        runs, choosing_runs, after, rows.train, rows.choosing, finding.winner
    )
    if winner is not finding.winner:
        after, from_tolerances = _identified_with_effects(runs, winner, before, rows)
    from_tolerances |= shape_errors(rows.train, winner.fit)
    others = alternatives_of(finding.hypotheses, finding.winner, finding.named)
    absorbed = None
    if finding.verdict != UNEXPLAINED:
        absorbed = absorbed_effects(finding.hypotheses, candidates, finding.winner)
    larger = sets_with_small_effect(finding.hypotheses, absorbed, finding.winner, rows.choosing)
    others += [(hypothesis, "") for hypothesis, _ in larger]
    alternatives = [
        (_identified_with_effects(runs, other, before, rows)[0], law) for other, law in others
    ]
    if finding.verdict == UNEXPLAINED:
        alternatives.append((_by_held_out(finding, winner, after), ""))
    by_alternatives = errors_by_alternatives(after, alternatives)
    after = with_errors(after, by_alternatives)
    effects = tuple(
        with_shots(_with_further_errors(f, from_tolerances, by_alternatives), shots)
        for f in finding.named
    )
    after = with_effect_values(after, effects)
    shared = {
        name: _with_curve(after.parameters[name], name, used, rows.train, finding.winner)
        for name, (used, _) in shared_parameters(finding.winner, after).items()
    }
    after = replace(after, parameters={**after.parameters, **shared})
    notes = small_effect_notes(finding.winner, larger)
    return FittedModel(winner, after, effects, tuple(notes), absorbed)


def _by_held_out(finding: Finding, winner: Hypothesis, model: Model) -> Model:
    """Return the model with what choosing rows give for parameters that a residual may move.

    It has the parameters of the families of rows that keep more than noise: by other motions or on
    another day an unknown cause moves them otherwise. The rows are fitted, not the records: those
    would lack the judging blocks, which long filters reach from everywhere.
    """
    rows = finding.rows.choosing
    fit = fit_coefficients(rows, winner.fit.terms)
    values = fit.parameters(rows.rig)
    relative = {n: d / abs(fit.beta[n]) for n, d in deviations(rows, fit).items() if fit.beta[n]}
    families = set(map(family_of, equations_above_noise(finding.rows, winner)))
    moved = {n for family in families for n in parameters_of(model.rig, model.terms, family)}
    parameters = {
        n: replace(e, value=values[n], std=relative[n] * abs(values[n]))
        for n, e in model.parameters.items()
        if n in moved and n in relative and e.identified
    }
    return replace(model, parameters=parameters)


def _with_curve(
    estimate: Estimate, name: str, curve: Used, data: RegressionData, winner: Hypothesis
) -> Estimate:
    """Return a parameter that a free curve shares; its interval includes the whole curve.

    Half of it is the parameter itself and what would add as much to the rows as the curve does.
    """
    fit = winner.fit
    rows = design_matrix(data, fit.terms)
    column = rows.matrix[:, rows.names.index(name)]
    value, size = fit.beta[name], np.linalg.norm(contribution(data, fit, curve))
    half = abs(value) + float(size / np.linalg.norm(column))
    low, high = value - half, value + half
    if name == "b":
        low, high = reciprocal_interval(value, low, high)
    return replace(estimate, std=0.5 * (high - low) / IDENTIFY.normal_quantile, ci95=(low, high))


def with_effect_values(model: Model, effects: Sequence[JudgedEffect]) -> Model:
    """Return the model with a value for each number of the effects that it lacks.

    The records determine a curve as a whole, even where one of its values is mostly noise, and a
    level beside others; without that value the model could not be simulated. It is the effect's,
    with its interval.
    """
    known = {n: e for f in effects for n, e in f.parameters.items()}
    parameters = {n: e if e.identified else known.get(n, e) for n, e in model.parameters.items()}
    return replace(model, parameters=parameters)


def _identified_with_effects(
    runs: Sequence[Run], winner: Hypothesis, before: Model, rows: TraceRows
) -> tuple[Model, dict[str, float]]:
    """Return the model identified together with the effects of a set, and errors by tolerance.

    Its intervals include the uncertainty of shapes and forms. The second value is the part of each
    standard error that the tolerances of the rig's geometry make, by parameter name.
    """
    if not winner.effects:
        return before, {}
    train_data, own = rows.train, rows.filtering

    def like_rows(filtering: Filtering) -> Filtering:
        return replace(
            filtering, in_motion=own.in_motion, full_weight=own.full_weight, lines=own.lines
        )

    found = identified(runs, (*train_data.terms, *winner.effects), like_rows)
    shift = form_shift(train_data, winner.fit)
    model = with_form_errors(train_data, winner.fit, found.model, shift)
    geometry = found.geometry
    by_geometry = {} if geometry is None else geometry.uncertainties(found.estimates)
    return at_nominal_temperature(model), by_geometry


def identified(
    runs: Sequence[Run],
    terms: Sequence[Used],
    changed: Callable[[Filtering], Filtering] = lambda filtering: filtering,
) -> Identification:
    """Return a model's identified parameters.

    Temperature and spool path are left out of `terms`: the estimator fits them itself. `changed`
    returns the filters of a record in place of the default ones.
    """
    nuisances = (BulkTemperature, DrivePath, SpoolPath)
    kept = ordered([u for u in terms if not isinstance(u.term, nuisances)])

    def filtering(record: Record) -> Filtering:
        return changed(default_filtering(record))

    return coupled(runs, kept, filtering, estimator=ESTIMATOR)


def _with_further_errors(effect: JudgedEffect, *errors: Mapping[str, float]) -> JudgedEffect:
    """Return an effect whose intervals include further standard errors, by parameter name."""
    parameters = {
        name: with_form_error(estimate, math.hypot(*(e.get(name, 0.0) for e in errors)))
        for name, estimate in effect.parameters.items()
    }
    return replace(effect, parameters=parameters)


def shoot_hidden_states(
    runs: Sequence[Run],
    holdout: Sequence[Run],
    after: Model,
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
) -> tuple[Hypothesis, list[ShootingEstimate]]:
    """Return the set after multiple shooting of its effects with a hidden state, and their shapes.

    `after` is the identified model of the set `winner`; electric rigs are returned unchanged.
    """
    shots: list[ShootingEstimate] = []
    if after.rig.electric or not hidden_effects(after):
        return winner, shots
    ready = completed([*runs, *holdout], after)
    if ready is None:
        return winner, shots
    after = ready
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
    return winner, shots


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
