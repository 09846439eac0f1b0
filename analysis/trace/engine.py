"""The trace: from a residual to the effect that the model lacks, and the error with it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from analysis.effects.base import Effect, ordered
from analysis.effects.disturbance import PeriodicDisturbance
from analysis.effects.mechanics import Payload
from analysis.identify import checks as ck
from analysis.identify.coupled import with_identified_bulk_modulus
from analysis.identify.geometry import NAME as GEOMETRY
from analysis.simulation.model import Model
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, joint_of
from analysis.trace.clues.dependence import clues_to
from analysis.trace.data.candidates import (
    at_start,
    catalogue,
    effect_in,
    effects_among,
    free_mechanisms,
)
from analysis.trace.data.conditioned_record import moving_filtering
from analysis.trace.data.nuisance_terms import temperature_terms
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows, refuse_repeated_records
from analysis.trace.data.spectral_lines import spectral_lines
from analysis.trace.data.trace_rows import TraceRuns, trace_rows, with_other_motions_apart
from analysis.trace.finding import Finding, remaining_fraction
from analysis.trace.fitted_model import FittedModel, identified, model_with_effects
from analysis.trace.in_motion import find, held_out_ratios, joints_with_friction, rest_phase_notes
from analysis.trace.judge import gates, held_out
from analysis.trace.judge.curves import CurveRange
from analysis.trace.judge.unrepeated import phase_notes, unlocked_lines, unrepeated_notes
from analysis.trace.judging import Candidates
from analysis.trace.next_experiment.detection_limits import (
    absorbed_effects,
    detection_limit_notes,
    detection_limits,
)
from analysis.trace.next_experiment.proposal import propose
from analysis.trace.notes import (
    evidence_notes,
    exact_geometry_notes,
    geometry_note,
    narrower_rows_note,
    not_judged_notes,
    quicker_motion_notes,
    record_condition_notes,
    refitted_notes,
    rival_notes,
    shared_parameters,
    slow_residual_note,
    undetermined_notes,
    unseen_load_notes,
    wider_rows_note,
)
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, Gate, Trace
from analysis.trace.search.geometry import Geometry, geometry_for_smaller_set
from analysis.trace.search.hypothesis import Hypothesis, Key, effect_of
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.undeclared_loads import MECHANICAL, undeclared_load
from analysis.trace.settings import SEARCH, TRACE
from analysis.trace.unmeasured_noise import noise_beside_effects, unstated_noise
from analysis.trace.words import sentence, tolerated_error_notes
from analysis.workers.pool import Pool, Serial
from rig.model.parse import InputError
from rig.model.records import Run, bandwidth_of, of_bandwidth, refuse_malformed, with_loads_stated
from rig.model.rig import Rig

log = logging.getLogger(__name__)

# Share of the work done after each stage, as measured on six records: reported as progress.
PREPARED, COLUMNS, JUDGED = 0.1, 0.55, 0.8


def trace(
    runs: Sequence[Run],
    holdout: Sequence[Run],
    effects: Sequence[Effect] | None = None,
    seed: int = 0,
    families: Sequence[str] = tuple(FAMILIES),
    look_ahead: bool = True,
    terms: Sequence[Used] | None = None,
    free_forms: bool = True,
    progress: Callable[[float], None] | None = None,
    judge: Sequence[Run] = (),
    pool: Pool | None = None,
) -> Trace:
    """Return the effects that the baseline lacks on `runs`, with their errors on other records.

    All parameters are fitted to `runs`. Records of `holdout` choose between effects and forms.
    Those of `judge` are read once, after everything is chosen: they give the errors, and may turn
    the verdict into `unexplained`. Without them a third of the held-out rows is set aside for that
    (`data.set_aside`).

    `effects`: the candidates, by default the whole catalogue at every place.
    `seed`: of the sign flips.
    `families`: the families of equations to trace, torque or flow. They share no parameter, so that
    a residual in one does not hide an effect in the other.
    `look_ahead`: design the next experiment.
    `terms`: a model's terms in place of the baseline's; shapes of its effects are not searched.
    `free_forms`: try mechanisms whose curve the data give where no named effect explains.
    `progress`: is called with the share of the work done, during the search with the same again.
    `pool`: computes the fits, by default in this process; results are the same with any pool that
    takes closures.

    Raises InputError for records of different rigs, for no held-out records, for held-out or
    judging records that are equal to others, and for records that are too short.
    """
    started = time.perf_counter()
    for task_runs in (runs, holdout, judge):
        refuse_malformed(task_runs)
    rig = ck.common_rig([*runs, *holdout, *judge])
    refuse_repeated_records(runs, holdout, judge)
    known = tuple(map(Used, baseline_of(rig))) if terms is None else tuple(terms)
    effects = catalogue(rig) if effects is None else effects
    options = _Options(effects, seed, look_ahead, free_forms, pool or Serial())
    quicker = quicker_motion_notes(runs, (*holdout, *judge))
    all_runs = [*runs, *holdout, *judge]
    width = _bandwidth_of_rows(runs, all_runs)
    separated, apart = with_other_motions_apart(of_bandwidth(with_loads_stated(all_runs), width))
    in_order = iter(separated)
    train, unseen, judging = (tuple(next(in_order) for _ in x) for x in (runs, holdout, judge))
    train, unseen, judging = with_identified_bulk_modulus(train, known, unseen, judging)
    with_b = ck.common_rig([*train, *unseen, *judging])
    records = TraceRuns(with_b, known, train, unseen, judging, tuple(families))
    progress = _without_steps_back(progress or (lambda _: None))
    result = _traced(records, options, progress)
    in_other_rows, slow = _traced_in_narrower_rows(records, options, result, progress)
    in_other_rows = in_other_rows or _traced_in_wider_rows(records, options, result, progress)
    result = _with_stated_rig(rig, in_other_rows or replace(result, notes=(*slow, *result.notes)))
    notes = (*quicker, *apart)
    result = replace(result, notes=(*notes, *result.notes))
    may_be_load = any(effect.name == Payload.name for effect in effects)
    may_be_load &= all(used.term.name != Payload.name for used in known)
    load = None
    if result.verdict == UNEXPLAINED and MECHANICAL in families and may_be_load:
        refused = [effect_of(f.name, f.at) for f in filter(gates.removes, result.refused)]
        load = undeclared_load(records, refused)
    if load is not None:
        again = _with_stated_rig(rig, _traced(load.records, options, progress))
        if again.verdict != UNEXPLAINED and Payload.name in {f.name for f in again.effects}:
            result = replace(again, notes=(*notes, load.words, *again.notes))
        elif load.shows_inertia:
            result = replace(result, notes=(*result.notes, load.words))
    return replace(result, seconds=time.perf_counter() - started)


def _without_steps_back(report: Callable[[float], None]) -> Callable[[float], None]:
    """Return a report of progress that stays where it is while a search is repeated."""
    reached = 0.0

    def progress(share: float) -> None:
        nonlocal reached
        reached = max(reached, share)
        report(reached)

    return progress


def _with_stated_rig(rig: Rig, result: Trace) -> Trace:
    """Return a trace whose models are of the rig as stated in its file."""
    before, after = (replace(m, rig=rig) for m in (result.model_before, result.model_after))
    return replace(result, model_before=before, model_after=after)


@dataclass(frozen=True)
class _Options:
    """Candidates and further options of `trace`."""

    effects: Sequence[Effect]
    seed: int
    look_ahead: bool
    free_forms: bool
    pool: Pool
    sets: Sequence[Sequence[Used]] = ()


@dataclass(frozen=True)
class _Prepared:
    """The input of the search: rows without unlocked lines, candidates, the identified baseline.

    `as_recorded` are the training rows with the lines, `notes` those on the baseline's parameters.
    """

    records: TraceRuns
    rows: TraceRows
    as_recorded: RegressionData
    candidates: Candidates
    baseline: Model
    notes: tuple[str, ...]


def _prepared(records: TraceRuns, options: _Options) -> _Prepared:
    """Build the rows and candidates, and identify the baseline."""
    rig, known = records.rig, records.terms
    temperature = temperature_terms(known, records.train, records.unseen)
    records = replace(records, terms=ordered((*known, *temperature)))
    as_recorded = rows = trace_rows(records)
    # Sines whose phase differs between repeats are taken out.
    if lines := unlocked_lines(rows.train):
        records = replace(records, lines=lines)
        rows = trace_rows(records)
    moving = len({joint_of(s.equation) for s in rows.train.segments})
    baseline = identified(records.train, rows.train.terms)
    notes = (
        *undetermined_notes(baseline.model),
        *(c.detail for c in baseline.checks if c.name == GEOMETRY and rig.uncertain_numbers),
    )
    candidates = Candidates(
        _lacking_candidates(options.effects, known, moving),
        _lacking_candidates(free_mechanisms(rig), known) if options.free_forms else [],
        options.seed,
        options.pool,
        options.sets,
    )
    return _Prepared(records, rows, as_recorded.train, candidates, baseline.model, notes)


def _with_noise_ratio(prepared: _Prepared, ratio: Mapping[str, float]) -> _Prepared:
    """Return the input of the search with a noise over the stated noise, by equation."""
    noise_ratio = {**prepared.records.noise_ratio, **ratio}
    records = replace(prepared.records, noise_ratio=noise_ratio)
    return replace(prepared, records=records, rows=trace_rows(records))


def _with_free_runs(
    prepared: _Prepared, records: TraceRuns, finding: Finding
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


def _bandwidth_of_rows(train: Sequence[Run], all_runs: Sequence[Run]) -> float | None:
    """Return the bandwidth [Hz] that the rows are filtered for: that of the training records.

    Training records with excited lines have none, and do not limit that of the others.
    """
    return bandwidth_of(train) or bandwidth_of(all_runs)


def _traced(records: TraceRuns, options: _Options, progress: Callable[[float], None]) -> Trace:
    """Trace records whose loads are stated, or taken to be the same (see `trace`)."""
    prepared, finding = _searched(records, options, progress)
    if geometry := _geometry_that_explains(prepared, finding):
        again = _traced_within_tolerances(records, options, finding, geometry, progress)
        if again is not None:
            return again
    progress(JUDGED)
    return _concluded(prepared, options, finding)


def _searched(
    records: TraceRuns, options: _Options, progress: Callable[[float], None]
) -> tuple[_Prepared, Finding]:
    """Return the input of the search, and the judged set of effects that explains most."""
    prepared = _prepared(records, options)

    def columns(share: float) -> None:
        progress(PREPARED + (COLUMNS - PREPARED) * share)

    def found(p: _Prepared) -> Finding:
        return find(p.records, p.rows, p.candidates, columns)

    finding = found(prepared)
    for measured in (unstated_noise, noise_beside_effects):
        if ratio := measured(finding):
            prepared = _with_noise_ratio(prepared, ratio)
            finding = found(prepared)
    return prepared, finding


def _concluded(prepared: _Prepared, options: _Options, finding: Finding) -> Trace:
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


def _geometry_that_explains(prepared: _Prepared, finding: Finding) -> Geometry | None:
    """Return a geometry within the rig file's tolerances that explains with another set, or None.

    The set is smaller than that of a finding that explains (`geometry_for_smaller_set`). Fitted to
    the rows of the moved rig, it must leave the choosing rows within the band.
    """
    explained = finding.verdict != UNEXPLAINED
    geometry = geometry_for_smaller_set(finding.hypotheses, finding.winner, explained)
    if geometry is None:
        return None
    used = finding.rows.filtering
    filtering = moving_filtering(used.in_motion, used.full_weight)
    rows = trace_rows(prepared.records.of_rig(geometry.rig), filtering)
    hypotheses, refined = _refined_on(rows, geometry.effects)
    above_band = gates.equations_above_band(hypotheses, refined, rows.choosing)
    return None if above_band else geometry


def _traced_within_tolerances(
    records: TraceRuns, options: _Options, finding: Finding, geometry: Geometry,
    progress: Callable[[float], None],
) -> Trace | None:  # fmt: skip
    """Return the answer with another geometry, None unless it explains, with a smaller set."""
    explained = finding.verdict != UNEXPLAINED
    prepared, moved = _searched(records.of_rig(geometry.rig), options, progress)
    sizes = [
        (len(effects), sum(len(e.parameters) for e in effects))
        for effects in (moved.named, finding.named)
    ]
    if moved.verdict == UNEXPLAINED or (explained and sizes[0] >= sizes[1]):
        return None
    after = held_out_ratios(moved.rows, moved.winner)
    for equation, ratio in held_out_ratios(finding.rows, finding.winner).items():
        if after[equation] > max(TRACE.noted_ratio, SEARCH.simpler_ratio * ratio):
            return None
    again = _concluded(prepared, options, moved)
    if again.verdict == UNEXPLAINED:
        return None
    note = geometry_note(geometry, finding.named, explained)
    return replace(again, notes=(note, *again.notes))


def _traced_in_narrower_rows(
    records: TraceRuns, options: _Options, result: Trace, progress: Callable[[float], None]
) -> tuple[Trace | None, tuple[str, ...]]:
    """Return a better answer in rows of lower frequencies, None where there is none, and notes.

    All candidates are searched there where a result explains nothing, and where it leaves
    `TRACE.loud_ratio` floors; where that names nothing, a note says so. Else the sets with tied
    rivals are compared: fewer must be tied. The effects must leave no more than noise in the
    judging rows of the measured bandwidth too.
    """
    width = records.bandwidth
    if width is None:
        return None, ()
    narrower = TRACE.narrower_bandwidth * width
    narrower_records = records.of_bandwidth(narrower)
    rig = result.model_after.rig  # with numbers within the tolerances that explain more
    loud = {}
    try:
        if result.verdict != UNEXPLAINED:
            loud = _loud_equations(narrower_records.of_rig(rig), options, result)
        fails = result.verdict == UNEXPLAINED or bool(loud)
        if not fails:
            sets = _sets_that_may_hold(result, rig)
            if len(sets) == 1 or rig != records.rig:
                return None, ()
            among = list({used.term.key: effect_in(used) for s in sets for used in s}.values())
            options = replace(options, effects=among, free_forms=False, sets=sets)
        again = _traced(narrower_records, options, progress)
    except InputError as error:  # the longer filter leaves too few rows of short records
        log.info("not traced in rows up to %.3g Hz: %s", narrower, error)
        return None, ()
    as_many = len(again.effects) == len(result.effects)
    is_better = fails or (as_many and set(again.tied_at) < set(result.tied_at))
    is_better &= again.verdict in (EXPLAINED, CONFOUNDED)
    if not is_better or not _explain_judging_rows(trace_rows(records), _named_terms(again)):
        return None, tuple(slow_residual_note(e, ratio, narrower) for e, ratio in loud.items())
    return replace(again, notes=(narrower_rows_note(narrower, width), *again.notes)), ()


def _sets_that_may_hold(result: Trace, rig: Rig) -> list[list[Used]]:
    """Return the set of effects that a trace names, and those with a tied rival in place of one.

    Rivals of two effects take the place of both together: then there is no set to compare.
    """
    named = {used.term.key: used for used in _named_terms(result)}
    sets = [named]
    rivals_of_each = [{(r.name, r.at) for r in e.rivals if r.tied} for e in result.effects]
    if sum(map(len, rivals_of_each)) > len(set[Key]().union(*rivals_of_each)):
        return [list(named.values())]
    for effect in result.effects:
        others = {key: used for key, used in named.items() if key != (effect.name, effect.at)}
        for rival in (r for r in effect.rivals if r.tied):
            rivals = (effect_of(r.name, r.at or r.where) for r in rival.effects)
            sets.append({**{r.key: at_start(rig, r) for r in rivals}, **others})
    return [list(effects.values()) for effects in sets]


def _named_terms(result: Trace) -> list[Used]:
    """Return the effects that a trace names, with their shapes."""
    named = {(effect.name, effect.at) for effect in result.effects}
    return [used for used in result.model_after.terms if used.term.key in named]


def _loud_equations(records: TraceRuns, options: _Options, result: Trace) -> dict[str, float]:
    """Return the equations of which an answer leaves `TRACE.loud_ratio` floors, and how many.

    The choosing rows of records count; where friction is among the effects, those of its joint's
    torque balance in motion only. A free curve is not compared: it has a form error that narrower
    rows show.
    """
    if any(effect.free for effect in result.effects):
        return {}
    effects, prepared = _named_terms(result), _prepared(records, options)
    rows = prepared.rows
    if joints := {e.joint for e in effects_among(effects) if e.family == "friction"}:
        rows = trace_rows(prepared.records, moving_filtering(joints))
    ratios = held_out_ratios(rows, _refined_on(rows, effects)[1])
    return {e: ratio for e, ratio in ratios.items() if ratio >= TRACE.loud_ratio}


def _traced_in_wider_rows(
    records: TraceRuns, options: _Options, result: Trace, progress: Callable[[float], None]
) -> Trace | None:
    """Return a clean result with torques above the motion's frequencies named, None without any.

    Repeats show them in wider rows. The errors are of these, where an inertia may be attenuated by
    noise; model and free runs stay, which leave out torques of another phase in each record.
    """
    width = records.bandwidth
    repeated = any(record.repeat > 1 for run in records.train for record in run.records)
    if result.verdict != CLEAN or not repeated or width is None or width >= TRACE.wider_bandwidth:
        return None
    wider = records.of_bandwidth(TRACE.wider_bandwidth)
    lines = unlocked_lines(trace_rows(wider).train)
    if not lines:
        return None
    again = _traced(wider, replace(options, look_ahead=False), progress)
    if not again.effects or any(e.name != PeriodicDisturbance.name for e in again.effects):
        return None
    result = replace(
        result, verdict=EXPLAINED, effects=again.effects, noise_floor=again.noise_floor,
        before=again.before, after=again.after, size=again.size, rows_before=again.rows_before,
        rows_after=again.rows_after,
        notes=(wider_rows_note(width), *phase_notes(again.effects, lines), *result.notes),
    )  # fmt: skip
    return replace(result, sentence=sentence(result))


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
        if _explain_judging_rows(rows, winner.effects):
            above_band, notes = set(), rest_phase_notes(joints, included=True)
    return (UNEXPLAINED if above_band else finding.verdict), notes


def _explain_judging_rows(rows: TraceRows, effects: Sequence[Used]) -> bool:
    """Return whether effects, refined on the training rows, leave the judging rows in the band."""
    hypotheses, refined = _refined_on(rows, effects)
    return not judging_rows_above_band(rows.judging, hypotheses.empty, refined)[0]


def _refined_on(rows: TraceRows, effects: Sequence[Used]) -> tuple[HypothesisSet, Hypothesis]:
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


def _lacking_candidates(
    candidates: Sequence[Effect], known: Sequence[Used], moving: int = 1
) -> list[Effect]:
    """Return the candidates that the model lacks and that can act where `moving` joints move."""
    in_model = {u.term.key for u in known}
    lacking = [c for c in candidates if c.key not in in_model]
    return [c for c in lacking if c.least_joints <= moving]
