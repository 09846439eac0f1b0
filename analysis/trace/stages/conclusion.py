"""The answer from a finding: models, free runs, errors of the judging rows, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from analysis.terms.base import Used
from analysis.trace.clues.dependence import clues_to
from analysis.trace.data.conditioned_record import moving_filtering
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.data.spectral_lines import spectral_lines
from analysis.trace.data.trace_rows import TraceRuns, trace_rows
from analysis.trace.finding import Finding, remaining_fraction
from analysis.trace.fitted_model import FittedModel, model_with_effects
from analysis.trace.in_motion import joints_with_friction, rest_phase_notes
from analysis.trace.judge import gates, held_out
from analysis.trace.judge.curves import CurveRange
from analysis.trace.judge.unrepeated import phase_notes, unrepeated_notes
from analysis.trace.next_experiment.detection_limits import (
    absorbed_effects,
    detection_limit_notes,
    detection_limits,
)
from analysis.trace.next_experiment.proposal import propose
from analysis.trace.notes import (
    evidence_notes,
    exact_geometry_notes,
    not_judged_notes,
    record_condition_notes,
    refitted_notes,
    rival_notes,
    shared_parameters,
    undetermined_notes,
    unseen_load_notes,
)
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, Gate, Trace
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.stages.preparation import PreparedTrace, TraceOptions
from analysis.trace.words import sentence, tolerated_error_notes


def conclude(prepared: PreparedTrace, options: TraceOptions, finding: Finding) -> Trace:
    """Return the trace of a finding: models, free runs, errors of the judging rows, next step."""
    baseline = prepared.baseline
    records = replace(prepared.records, lines=finding.rows.filtering.lines)
    finding, fitted, free_runs = _with_free_runs(prepared, records, finding)
    hypotheses, rows, train_data = finding.hypotheses, finding.rows, finding.rows.train
    lines = spectral_lines(train_data, finding.winner.fit.residual)
    clues, formulas = (
        ((), ())
        if finding.verdict in (CLEAN, EXPLAINED) or finding.trained_on_noise
        else clues_to(train_data, rows.choosing, finding.winner, lines)
    )
    further = (
        propose(hypotheses, finding.winner, finding.named, finding.verdict, clues)
        if options.look_ahead
        else None
    )
    winner, model = fitted.winner, fitted.model
    if winner is not finding.winner:
        lines = spectral_lines(train_data, winner.fit.residual)
    # Everything is chosen. From here on the judging rows are read, and nothing is chosen by them.
    fit_before, fit_after = (
        held_out.refitted_to_held_out(rows.judging, fit)
        for fit in (hypotheses.empty.fit, winner.fit)
    )
    curves = CurveRange(rows.judging, winner.fit).limits
    error = held_out.errors(
        records.rig, rows.members, fit_before, fit_after, rows.divided, curves, train_data.floors,
        records.noise_ratio,
    )  # fmt: skip
    verdict, judging_notes = _final_verdict(records, finding, winner)
    limits = []
    if verdict != UNEXPLAINED:
        absorbed = fitted.absorbed
        if winner is not finding.winner:
            absorbed = absorbed_effects(hypotheses, prepared.candidates.named, winner)
        limits = detection_limits(absorbed, winner, model)
    notes = [
        *unseen_load_notes(records.train, records.unseen),
        *prepared.rows.notes,
        *evidence_notes(prepared.rows.train, prepared.rows.choosing),
        *prepared.notes,
        *unrepeated_notes(train_data),
        *finding.notes,
        *(
            not_judged_notes(finding.remainders, error.noise, error.after)
            if finding.verdict == UNEXPLAINED and not finding.notes
            else ()
        ),
        *phase_notes(finding.named, records.lines),
        *(rival_notes(finding.named) if finding.verdict == CONFOUNDED else ()),
        *refitted_notes(
            winner.fit, fit_after, model, held_out.oil_changes(rows.judging, winner.fit)
        ),
        *(why for _, why in shared_parameters(winner, model).values()),
        *record_condition_notes(train_data, winner),
        *exact_geometry_notes(records.rig, finding.named),
        *undetermined_notes(model, baseline, finding.rows.filtering.in_motion),
        *judging_notes,
        *fitted.notes,
        *detection_limit_notes(limits),
    ]
    runs_before, runs_after = free_runs
    remaining = 0.0
    if verdict != CLEAN and not finding.trained_on_noise:
        remaining = remaining_fraction(hypotheses, winner, prepared.as_recorded)
    result = Trace(
        verdict, fitted.effects, error.noise, error.before, error.after,
        runs_before.fit, runs_after.fit, baseline, model,
        remaining, clues, further,
        prepared.as_recorded.floors, fit_before, fit_after, tuple(notes),
        refused=finding.refused, size=error.size,
        rmse_before=runs_before.rmse, rmse_after=runs_after.rmse,
        window_before=runs_before.window_rmse, window_after=runs_after.window_rmse,
        lines=lines, formulas=formulas,
        free_curves=held_out.free_curves(runs_before, runs_after),
        detection_limits=tuple(limits),
    )  # fmt: skip
    notes += tolerated_error_notes(result)
    return replace(result, notes=tuple(notes), sentence=sentence(result))


def _with_free_runs(
    prepared: PreparedTrace, records: TraceRuns, finding: Finding
) -> tuple[Finding, FittedModel, tuple[held_out.FreeRunErrors, held_out.FreeRunErrors]]:
    """Return the finding, its model and the free runs of unseen records before and after.

    Effects with which the free run fails or is far worse than without them are not named. A free
    run with parameters of the model without them (`held_out.completed`) is no evidence against it.
    """
    baseline = prepared.baseline

    def fit(finding: Finding) -> FittedModel:
        choosing, named = prepared.rows.choosing_runs, prepared.candidates.named
        return model_with_effects(prepared.records, choosing, baseline, named, finding)

    fitted = fit(finding)
    simulated = held_out.completed(fitted.model, baseline)
    runs_before, runs_after = held_out.free_runs(
        records.unseen, baseline, simulated, prepared.candidates.pool
    )
    if simulated is fitted.model and (worse := held_out.worse_free_run(runs_before, runs_after)):
        finding = finding.refused_by(Gate(gates.FREE_RUN, False, worse))
        fitted, runs_after = fit(finding), runs_before
    return finding, fitted, (runs_before, runs_after)


def _final_verdict(
    records: TraceRuns, finding: Finding, winner: Hypothesis
) -> tuple[str, list[str]]:
    """Return the verdict after the judging rows, and notes on equations above the band there.

    Where these are torque balances in which friction of the set acts, their rows are judged again
    with weights by speed, 0 at rest.
    """
    if finding.verdict == UNEXPLAINED:
        return UNEXPLAINED, []
    judging, empty = finding.rows.judging, finding.hypotheses.empty
    above_band, notes = judging_rows_above_band(judging, empty, winner)
    joints = joints_with_friction(winner, above_band)
    if joints and not finding.rows.filtering.in_motion:
        rows = trace_rows(records, moving_filtering(joints))
        if explain_judging_rows(rows, winner.effects):
            above_band, notes = set(), rest_phase_notes(joints, included=True)
    return (UNEXPLAINED if above_band else finding.verdict), notes


def explain_judging_rows(rows: TraceRows, effects: Sequence[Used]) -> bool:
    """Return whether effects, refined on the training rows, leave the judging rows in the band."""
    hypotheses, refined = refined_on(rows, effects)
    return not judging_rows_above_band(rows.judging, hypotheses.empty, refined)[0]


def refined_on(rows: TraceRows, effects: Sequence[Used]) -> tuple[HypothesisSet, Hypothesis]:
    """Return the exact fit of effects to the training rows of `rows`, and the set that it is of."""
    hypotheses = HypothesisSet(rows.train, [])
    return hypotheses, hypotheses.refined(effects)


def judging_rows_above_band(
    judge_data: RegressionData, before: Hypothesis, after: Hypothesis
) -> tuple[set[str], list[str]]:
    """Return the equations whose judging rows are above the band, and notes on them."""
    within_curves = CurveRange(judge_data, after.fit)
    above = gates.held_out_above_band(within_curves.rows, before.fit, after.fit)
    remaining = [(e, figure) for e, figure in above if e not in within_curves.beyond]
    notes = [f"{e}: {figure} in the records that judge" for e, figure in remaining]
    return {e for e, _ in remaining}, [*notes, *within_curves.notes]
