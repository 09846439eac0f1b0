"""The model with the effects that a trace found, and the intervals of its parameters.

Shapes of effects with a hidden state are also searched by multiple shooting, from those found with
the rows (see `analysis.identify.output_error.hidden_states`). They are used where they bring the
simulation closer to held-out records and do not increase the errors of held-out rows. Otherwise the
shapes from the rows are kept, and each interval is extended to include both values: estimates that
differ by more than their errors show that the effect's form is simpler than the real one.
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
from analysis.trace.judge.alternatives import (
    alternatives_of,
    errors_by_alternatives,
    shape_errors_by_alternatives,
)
from analysis.trace.judge.held_out import rms_of
from analysis.trace.judge.inference import with_form_error
from analysis.trace.judge.rivals import deviations
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
    baseline: Model,
    candidates: Sequence[Effect],
    finding: Finding,
) -> FittedModel:
    """Identify the model with the effects found, hidden states by multiple shooting.

    `baseline` is the baseline's model, `choosing_runs` and `candidates` are those of the search.
    """
    runs, rows = records.train, finding.rows
    model, from_tolerances = _identified_with_effects(runs, finding.winner, baseline, rows)
    winner, shots = shoot_hidden_states(
        runs, choosing_runs, model, rows.train, rows.choosing, finding.winner
    )
    if winner is not finding.winner:
        model, from_tolerances = _identified_with_effects(runs, winner, baseline, rows)
    from_tolerances |= shape_errors(rows.train, winner.fit)
    others = alternatives_of(finding.hypotheses, finding.winner, finding.named, rows.choosing)
    absorbed = None
    if finding.verdict != UNEXPLAINED:
        absorbed = absorbed_effects(finding.hypotheses, candidates, finding.winner)
    larger = sets_with_small_effect(finding.hypotheses, absorbed, finding.winner, rows.choosing)
    others += [(hypothesis, "") for hypothesis, _ in larger]
    alternatives = [
        (_identified_with_effects(runs, other, baseline, rows)[0], law) for other, law in others
    ]
    if finding.verdict == UNEXPLAINED:
        alternatives.append((_fitted_to_choosing_rows(finding, winner, model), ""))
    by_alternatives = errors_by_alternatives(model, alternatives)
    model = with_errors(model, by_alternatives)
    other_sets = [hypothesis for hypothesis, _ in others]
    by_alternatives |= shape_errors_by_alternatives(rows.train.rig, finding.winner, other_sets)
    effects = tuple(
        with_shots(_with_further_errors(f, from_tolerances, by_alternatives), shots)
        for f in finding.named
    )
    model = with_effect_values(model, effects)
    shared = {
        name: _with_curve(model.parameters[name], name, used, rows.train, finding.winner)
        for name, (used, _) in shared_parameters(finding.winner, model).items()
    }
    model = replace(model, parameters={**model.parameters, **shared})
    notes = small_effect_notes(finding.winner, larger)
    return FittedModel(winner, model, effects, tuple(notes), absorbed)


def _fitted_to_choosing_rows(finding: Finding, winner: Hypothesis, model: Model) -> Model:
    """Return the model with parameters fitted to the choosing rows in families above the noise.

    An unknown cause biases them otherwise in other motions or on another day. The rows are fitted,
    not the records: without the judging blocks, long filters would leave hardly any row.
    """
    rows = finding.rows.choosing
    fit = fit_coefficients(rows, winner.fit.terms)
    values = fit.parameters(rows.rig)
    relative = {n: d / abs(fit.beta[n]) for n, d in deviations(rows, fit).items() if fit.beta[n]}
    families = set(map(family_of, equations_above_noise(finding.rows, winner)))
    open_parameters = {
        n for family in families for n in parameters_of(model.rig, model.terms, family)
    }
    parameters = {
        n: replace(e, value=values[n], std=relative[n] * abs(values[n]))
        for n, e in model.parameters.items()
        if n in open_parameters and n in relative and e.identified
    }
    return replace(model, parameters=parameters)


def _with_curve(
    estimate: Estimate, name: str, curve: Used, data: RegressionData, winner: Hypothesis
) -> Estimate:
    """Return a parameter that a free curve shares; its interval includes the whole curve.

    Its half-width is the parameter itself plus the change that adds as much to the rows as the
    curve does.
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
    """Return the model with the effects' estimates of parameters that it has not identified.

    The records determine a curve as a whole even where one of its values is mostly noise; without
    that value the model could not be simulated.
    """
    effect_values = {n: e for f in effects for n, e in f.parameters.items()}
    parameters = {
        n: e if e.identified else effect_values.get(n, e) for n, e in model.parameters.items()
    }
    return replace(model, parameters=parameters)


def _identified_with_effects(
    runs: Sequence[Run], winner: Hypothesis, baseline: Model, rows: TraceRows
) -> tuple[Model, dict[str, float]]:
    """Return the model identified together with the effects of a set, and errors by tolerance.

    Its intervals include the uncertainty of shapes and forms. The second value is the standard
    error of each parameter by the tolerances of the rig's geometry, by name.
    """
    if not winner.effects:
        return baseline, {}
    train_data, used = rows.train, rows.filtering

    def like_rows(filtering: Filtering) -> Filtering:
        filtering = replace(filtering, in_motion=used.in_motion, lines=used.lines)
        return replace(filtering, full_weight=used.full_weight)

    identification = identified(runs, (*train_data.terms, *winner.effects), like_rows)
    shift = form_shift(train_data, winner.fit)
    model = with_form_errors(train_data, winner.fit, identification.model, shift)
    geometry = identification.geometry
    by_geometry = {} if geometry is None else geometry.uncertainties(identification.estimates)
    return at_nominal_temperature(model), by_geometry


def identified(
    runs: Sequence[Run],
    terms: Sequence[Used],
    changed: Callable[[Filtering], Filtering] = lambda filtering: filtering,
) -> Identification:
    """Return a model's parameters as `bramah identify` estimates them.

    Temperature and spool path are left out of `terms`: the estimator fits them itself. `changed`
    returns the filters of a record in place of the default ones.
    """
    nuisances = (BulkTemperature, DrivePath, SpoolPath)
    fitted_terms = ordered([u for u in terms if not isinstance(u.term, nuisances)])

    def filtering(record: Record) -> Filtering:
        return changed(default_filtering(record))

    return coupled(runs, fitted_terms, filtering)


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
    model: Model,
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
) -> tuple[Hypothesis, list[ShootingEstimate]]:
    """Return the set after multiple shooting of its effects with a hidden state, and their shapes.

    `model` is the identified model of the set `winner`; electric rigs are returned unchanged.
    """
    shots: list[ShootingEstimate] = []
    if model.rig.electric or not hidden_effects(model):
        return winner, shots
    complete = completed([*runs, *holdout], model)
    if complete is None:
        return winner, shots
    model = complete
    for effect in hidden_effects(model):
        shot_effect = shot(runs, model, effect)
        if shot_effect is None:
            continue
        shot_terms = _with_shapes_of(model.rig, model.terms, effect, shot_effect)
        shot_model = replace(model, terms=shot_terms)
        before, after = (window_error(holdout, m, effect) for m in (model, shot_model))
        fit_terms = _with_shapes_of(model.rig, winner.fit.terms, effect, shot_effect)
        shot_fit = fit_coefficients(train_data, fit_terms)
        rms, rms_shot = (rms_of(holdout_data, fit) for fit in (winner.fit, shot_fit))
        better = after < TRACE.shooting_ratio * before
        better = better and all(rms_shot[e] <= TRACE.shooting_cost * rms[e] for e in rms)
        taken = better and shot_effect.settled
        shots.append(replace(shot_effect, before=before, after=after, taken=taken))
        if taken:
            winner = replace(
                winner, effects=_with_shapes_of(model.rig, winner.effects, effect, shot_effect),
                fit=shot_fit, excess_energy=energy_above_noise(train_data, shot_fit.residual),
            )  # fmt: skip
            model = shot_model
    return winner, shots


def _with_shapes_of(
    rig: Rig, terms: Sequence[Used], effect: Effect, shot: ShootingEstimate
) -> tuple[Used, ...]:
    """Return the terms with the shapes from shooting; shapes that it did not search are kept."""
    values = {name: estimate.value for name, estimate in shot.shapes.items()}
    return tuple(
        Used(u.term, tuple({**shape_values(rig, u), **values}.values())) if u.term == effect else u
        for u in terms
    )


def with_shots(judged: JudgedEffect, shots: Sequence[ShootingEstimate]) -> JudgedEffect:
    """Return an effect with the shapes from shooting, or with intervals that include them."""
    for result in shots:
        if (result.name, result.where) == (judged.name, judged.where):
            shapes = dict(result.shapes)
            if not result.taken:
                for name, shot_shape in result.shapes.items():
                    estimate, value = judged.parameters[name], shot_shape.value
                    low, high = estimate.ci95
                    shapes[name] = replace(estimate, ci95=(min(low, value), max(high, value)))
            return replace(judged, parameters={**judged.parameters, **shapes}, shot=result)
    return judged
