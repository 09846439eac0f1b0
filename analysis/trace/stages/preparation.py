"""Rows, candidates and baseline of a trace, and the search on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from analysis.effects.base import Effect, ordered
from analysis.identify.geometry import NAME as GEOMETRY
from analysis.simulation.model import Model
from analysis.terms.base import Used, joint_of
from analysis.trace.data.candidates import free_mechanisms
from analysis.trace.data.nuisance_terms import temperature_terms
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.data.trace_rows import TraceRuns, trace_rows
from analysis.trace.finding import Finding
from analysis.trace.fitted_model import identified
from analysis.trace.in_motion import find
from analysis.trace.judge.unrepeated import unlocked_lines
from analysis.trace.judging import Candidates
from analysis.trace.notes import undetermined_notes
from analysis.trace.unmeasured_noise import noise_beside_effects, unstated_noise
from analysis.workers.pool import Pool

# Share of the work done after each stage, as measured on six records: reported as progress.
PREPARED, COLUMNS, JUDGED = 0.1, 0.55, 0.8


@dataclass(frozen=True)
class TraceOptions:
    """Candidates and further options of `trace`."""

    effects: Sequence[Effect]
    seed: int
    look_ahead: bool
    free_forms: bool
    pool: Pool
    sets: Sequence[Sequence[Used]] = ()


@dataclass(frozen=True)
class PreparedTrace:
    """The input of the search: rows without unlocked lines, candidates, the identified baseline.

    `as_recorded` are the training rows with the lines, `notes` those on the baseline's parameters.
    """

    records: TraceRuns
    rows: TraceRows
    as_recorded: RegressionData
    candidates: Candidates
    baseline: Model
    notes: tuple[str, ...]


def prepare(records: TraceRuns, options: TraceOptions) -> PreparedTrace:
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
    return PreparedTrace(records, rows, as_recorded.train, candidates, baseline.model, notes)


def _lacking_candidates(
    candidates: Sequence[Effect], known: Sequence[Used], moving: int = 1
) -> list[Effect]:
    """Return the candidates that the model lacks and that can act where `moving` joints move."""
    in_model = {u.term.key for u in known}
    lacking = [c for c in candidates if c.key not in in_model]
    return [c for c in lacking if c.least_joints <= moving]


def _with_noise_ratio(prepared: PreparedTrace, ratio: Mapping[str, float]) -> PreparedTrace:
    """Return the input of the search with a noise over the stated noise, by equation."""
    noise_ratio = {**prepared.records.noise_ratio, **ratio}
    records = replace(prepared.records, noise_ratio=noise_ratio)
    return replace(prepared, records=records, rows=trace_rows(records))


def searched(
    records: TraceRuns, options: TraceOptions, progress: Callable[[float], None]
) -> tuple[PreparedTrace, Finding]:
    """Return the input of the search, and the judged set of effects that explains most."""
    prepared = prepare(records, options)

    def columns(share: float) -> None:
        progress(PREPARED + (COLUMNS - PREPARED) * share)

    def found(p: PreparedTrace) -> Finding:
        return find(p.records, p.rows, p.candidates, columns)

    finding = found(prepared)
    for measured in (unstated_noise, noise_beside_effects):
        if ratio := measured(finding):
            prepared = _with_noise_ratio(prepared, ratio)
            finding = found(prepared)
    return prepared, finding
