"""The trace: from a residual to the effect that the model lacks, and the error with it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from analysis.effects.base import Effect
from analysis.effects.mechanics import Payload
from analysis.identify import checks as ck
from analysis.identify.coupled import with_identified_bulk_modulus
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.data.set_aside import refuse_repeated_records
from analysis.trace.data.trace_rows import TraceRuns, with_other_motions_apart
from analysis.trace.judge import gates
from analysis.trace.notes import quicker_motion_notes
from analysis.trace.result import UNEXPLAINED, Trace
from analysis.trace.search.hypothesis import effect_of
from analysis.trace.search.undeclared_loads import MECHANICAL, undeclared_load
from analysis.trace.stages.one_bandwidth import trace_one_bandwidth
from analysis.trace.stages.other_bandwidths import traced_in_narrower_rows, traced_in_wider_rows
from analysis.trace.stages.preparation import TraceOptions
from analysis.workers.pool import Pool, Serial
from rig.model.records import Run, bandwidth_of, of_bandwidth, refuse_malformed, with_loads_stated
from rig.model.rig import Rig


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
    options = TraceOptions(effects, seed, look_ahead, free_forms, pool or Serial())
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
    result = trace_one_bandwidth(records, options, progress)
    in_other_rows, slow = traced_in_narrower_rows(records, options, result, progress)
    in_other_rows = in_other_rows or traced_in_wider_rows(records, options, result, progress)
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
        again = _with_stated_rig(rig, trace_one_bandwidth(load.records, options, progress))
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


def _bandwidth_of_rows(train: Sequence[Run], all_runs: Sequence[Run]) -> float | None:
    """Return the bandwidth [Hz] that the rows are filtered for: that of the training records.

    Training records with excited lines have none, and do not limit that of the others.
    """
    return bandwidth_of(train) or bandwidth_of(all_runs)
