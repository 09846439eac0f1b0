"""Trace of what rows of lower or higher frequencies show and those of the motion hide."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from analysis.effects.disturbance import PeriodicDisturbance
from analysis.terms.base import Used
from analysis.trace.data.candidates import (
    at_start,
    effect_in,
    effects_among,
)
from analysis.trace.data.conditioned_record import moving_filtering
from analysis.trace.data.trace_rows import TraceRuns, trace_rows
from analysis.trace.in_motion import held_out_ratios
from analysis.trace.judge.unrepeated import phase_notes, unlocked_lines
from analysis.trace.notes import (
    narrower_rows_note,
    slow_residual_note,
    wider_rows_note,
)
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, Trace
from analysis.trace.search.hypothesis import Key, effect_of
from analysis.trace.settings import TRACE
from analysis.trace.stages.conclusion import explain_judging_rows, refined_on
from analysis.trace.stages.one_bandwidth import trace_one_bandwidth
from analysis.trace.stages.preparation import TraceOptions, prepare
from analysis.trace.words import sentence
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)


def traced_in_narrower_rows(
    records: TraceRuns, options: TraceOptions, result: Trace, progress: Callable[[float], None]
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
        again = trace_one_bandwidth(narrower_records, options, progress)
    except InputError as error:  # the longer filter leaves too few rows of short records
        log.info("not traced in rows up to %.3g Hz: %s", narrower, error)
        return None, ()
    as_many = len(again.effects) == len(result.effects)
    is_better = fails or (as_many and set(again.tied_at) < set(result.tied_at))
    is_better &= again.verdict in (EXPLAINED, CONFOUNDED)
    if not is_better or not explain_judging_rows(trace_rows(records), _named_terms(again)):
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


def _loud_equations(records: TraceRuns, options: TraceOptions, result: Trace) -> dict[str, float]:
    """Return the equations of which an answer leaves `TRACE.loud_ratio` floors, and how many.

    The choosing rows of records count; where friction is among the effects, those of its joint's
    torque balance in motion only. A free curve is not compared: it has a form error that narrower
    rows show.
    """
    if any(effect.free for effect in result.effects):
        return {}
    effects, prepared = _named_terms(result), prepare(records, options)
    rows = prepared.rows
    if joints := {e.joint for e in effects_among(effects) if e.family == "friction"}:
        rows = trace_rows(prepared.records, moving_filtering(joints))
    ratios = held_out_ratios(rows, refined_on(rows, effects)[1])
    return {e: ratio for e, ratio in ratios.items() if ratio >= TRACE.loud_ratio}


def traced_in_wider_rows(
    records: TraceRuns, options: TraceOptions, result: Trace, progress: Callable[[float], None]
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
    again = trace_one_bandwidth(wider, replace(options, look_ahead=False), progress)
    if not again.effects or any(e.name != PeriodicDisturbance.name for e in again.effects):
        return None
    result = replace(
        result, verdict=EXPLAINED, effects=again.effects, noise_floor=again.noise_floor,
        before=again.before, after=again.after, size=again.size, rows_before=again.rows_before,
        rows_after=again.rows_after,
        notes=(wider_rows_note(width), *phase_notes(again.effects, lines), *result.notes),
    )  # fmt: skip
    return replace(result, sentence=sentence(result))
