"""Trace in rows of one bandwidth, with areas, volumes and pins within their tolerances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from analysis.trace.data.conditioned_record import moving_filtering
from analysis.trace.data.trace_rows import TraceRuns, trace_rows
from analysis.trace.finding import Finding
from analysis.trace.in_motion import held_out_ratios
from analysis.trace.judge import gates
from analysis.trace.notes import geometry_note
from analysis.trace.result import UNEXPLAINED, Trace
from analysis.trace.search.geometry import Geometry, geometry_for_smaller_set
from analysis.trace.settings import SEARCH, TRACE
from analysis.trace.stages.conclusion import conclude, refined_on
from analysis.trace.stages.preparation import JUDGED, PreparedTrace, TraceOptions, searched


def trace_one_bandwidth(
    records: TraceRuns, options: TraceOptions, progress: Callable[[float], None]
) -> Trace:
    """Trace records whose loads are stated, or taken to be the same (see `trace`)."""
    prepared, finding = searched(records, options, progress)
    if geometry := _geometry_that_explains(prepared, finding):
        again = _traced_within_tolerances(records, options, finding, geometry, progress)
        if again is not None:
            return again
    progress(JUDGED)
    return conclude(prepared, options, finding)


def _geometry_that_explains(prepared: PreparedTrace, finding: Finding) -> Geometry | None:
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
    hypotheses, refined = refined_on(rows, geometry.effects)
    above_band = gates.equations_above_band(hypotheses, refined, rows.choosing)
    return None if above_band else geometry


def _traced_within_tolerances(
    records: TraceRuns, options: TraceOptions, finding: Finding, geometry: Geometry,
    progress: Callable[[float], None],
) -> Trace | None:  # fmt: skip
    """Return the answer with another geometry, None unless it explains, with a smaller set."""
    explained = finding.verdict != UNEXPLAINED
    prepared, moved = searched(records.of_rig(geometry.rig), options, progress)
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
    again = conclude(prepared, options, moved)
    if again.verdict == UNEXPLAINED:
        return None
    note = geometry_note(geometry, finding.named, explained)
    return replace(again, notes=(note, *again.notes))
