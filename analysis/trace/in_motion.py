"""The search on all rows, and in motion only where joints at rest hide the law of friction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.base import Effect
from analysis.effects.friction import force_unit
from analysis.regression.conditioned import ConditionedRecord
from analysis.terms.base import equation
from analysis.trace.data.candidates import effects_among
from analysis.trace.data.conditioned_record import conditioned_records, moving_filtering
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.data.trace_rows import TraceRuns, trace_rows
from analysis.trace.finding import Finding, without_unnamed_effects
from analysis.trace.judge import gates, held_out
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.unrepeated import judged_line
from analysis.trace.judging import Candidates, search_and_judge, with_free_form
from analysis.trace.notes import WITHOUT_RESTS
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, JudgedEffect
from analysis.trace.search.exact_fit import design_matrix
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.settings import TRACE


def find(
    records: TraceRuns, rows: TraceRows, candidates: Candidates, progress: Callable[[float], None]
) -> Finding:
    """Return the finding of `search_and_judge`, on rows in motion only where that is needed.

    No friction curve over speed fits the rows of a joint at rest: there free forms are tried in
    motion first. Torques at `records.lines` are judged beside the effects found. Where one is
    refused, it is left in the rows, and the search is repeated.
    """
    joints = {e.joint for e in candidates.named if e.family == "friction"}
    rests = any(_rests(rows.train.records, joint) for joint in joints)
    tried = replace(candidates, free=()) if rests else candidates
    on_all_rows = search_and_judge(rows, tried, progress)
    finding = searched_in_motion(records, candidates, progress, on_all_rows)
    if rests and finding is on_all_rows:
        finding = with_free_form(finding, candidates)
    finding = without_unnamed_effects(finding)
    if not records.lines:
        return finding
    judged_lines = _judged_lines(records, finding)
    refused = gates.refused_effects(judged_lines)
    if refused:
        judged = zip(records.lines, judged_lines, strict=True)
        fewer = replace(records, lines=tuple(line for line, e in judged if e not in refused))
        finding = find(fewer, trace_rows(fewer), candidates, progress)
        return replace(finding, effects=(*finding.effects, *refused))
    verdict = EXPLAINED if finding.verdict == CLEAN else finding.verdict
    return replace(finding, effects=(*finding.effects, *judged_lines), verdict=verdict)


def _judged_lines(records: TraceRuns, finding: Finding) -> tuple[JudgedEffect, ...]:
    """Return the torques at `records.lines` with their gates, beside the effects found."""
    rows, fit = finding.rows, finding.winner.fit
    train, holdout = (
        conditioned_records(records.rig, runs, families=records.families)
        for runs in (records.train, records.holdout)
    )
    judged = []
    for line in records.lines:
        balance = equation("torque", line[0])
        squares = [s.noise**2 for s in rows.choosing.segments if s.equation == balance]
        noise = float(np.sqrt(np.mean(squares))) if squares else np.inf
        judged.append(judged_line(records.rig, line, fit, train, holdout, rows.divided, noise))
    return tuple(judged)


def searched_in_motion(
    records: TraceRuns, candidates: Candidates, progress: Callable[[float], None], finding: Finding
) -> Finding:
    """Search again in rows weighted by speed, where a joint's torque balance is above the noise.

    While a joint rests, dry friction is any force up to its breakaway: no law of the speed fits
    these rows, and they hide the law in motion, and with it effects in other balances. The result
    is used if friction acts in each joint whose rows are weighted and it is better (`_is_better`);
    then the balances of other joints are searched. Where it lacks a breakaway that all rows show,
    slow samples get more weight.
    """
    above_noise, joints = _joints_to_weight(
        finding, [e for e in candidates.named if e.family == "friction"]
    )
    weighted = set(finding.rows.filtering.in_motion)
    if joints <= weighted:
        return finding

    def searched(joints: Collection[int], full_weight: float) -> Finding:
        unweighted = finding.rows.train.cache.without_family("mechanical")
        filtering = moving_filtering({*weighted, *joints}, full_weight)
        rows = trace_rows(records, filtering, unweighted)
        moving = search_and_judge(rows, candidates, progress)
        resting = rest_phase_notes(rows.filtering.in_motion, included=False)
        return replace(moving, notes=(*resting, *moving.notes))

    for full_weight in (1.0, TRACE.breakaway_speed):
        moving = searched(joints, full_weight)
        acting = joints_with_friction(moving.winner, above_noise)
        if acting and acting != joints:  # an effect of several balances had spread friction
            moving = searched(acting, full_weight)
        unmet = joints_with_friction(moving.winner, above_noise) != acting
        if acting <= weighted or unmet or not _is_better(moving, finding, acting):
            return finding
        if not any(_hides_breakaway(moving, finding, joint) for joint in acting):
            break
    else:
        return finding
    notes = *_breakaway_notes(moving, finding, acting), *moving.notes
    failed = tuple(f for f in finding.effects if not gates.passes_gates(f))
    moving = replace(moving, notes=notes, effects=(*moving.effects, *failed))
    return searched_in_motion(records, candidates, progress, moving)


def _joints_to_weight(finding: Finding, friction: Sequence[Effect]) -> tuple[set[str], set[int]]:
    """Return the equations above the noise, and the joints (0-based) whose rests may cause it.

    These have friction in the set, or, where the residual is `unexplained`, may have it and rest.
    """
    if finding.verdict == CLEAN:
        return set(), set()
    above_noise = equations_above_noise(finding.rows, finding.winner)
    joints = joints_with_friction(finding.winner, above_noise)
    if finding.verdict == UNEXPLAINED:
        above_band = {r.equation for r in finding.remainders if r.veto}
        friction_joints = {e.joint for e in friction if equation("torque", e.joint) in above_band}
        joints |= {joint for joint in friction_joints if _rests(finding.rows.train.records, joint)}
        above_noise |= above_band
    return above_noise, joints


def _rests(records: Sequence[ConditionedRecord], joint: int) -> bool:
    """Return whether a joint (0-based), not locked, is often much slower than its rms speed."""
    for record in records:
        speed = np.abs(record.signals.sd[:, joint])
        slow = speed < TRACE.rest_speed * float(np.sqrt(np.mean(speed**2)))
        if joint + 1 not in record.record.locked and float(np.mean(slow)) > TRACE.rest_share:
            return True
    return False


def _is_better(moving: Finding, on_all_rows: Finding, joints: Collection[int]) -> bool:
    """Return whether the finding `moving`, with rows of `joints` weighted by speed, is better.

    It must remove most of the energy of all rows, rests included. It explains what was unexplained,
    or it leaves at most `TRACE.noted_ratio` noise floors in the balances of `joints`, or
    `TRACE.motion_ratio` times as many as on all rows, and explains too or has fewer remainders with
    a veto.
    """
    total = on_all_rows.hypotheses.refined(moving.winner.effects).total
    if total / on_all_rows.hypotheses.empty.total > 1.0 - TRACE.least_removed:
        return False
    explains = moving.verdict in (EXPLAINED, CONFOUNDED)
    if explains and on_all_rows.verdict == UNEXPLAINED:
        return True
    fewer = sum(r.veto for r in moving.remainders) < sum(r.veto for r in on_all_rows.remainders)
    ratios, before = (held_out_ratios(f.rows, f.winner) for f in (moving, on_all_rows))
    balances = [equation("torque", joint) for joint in joints]
    meets_noise = all(
        ratios[e] <= max(TRACE.noted_ratio, TRACE.motion_ratio * before[e]) for e in balances
    )
    return (explains or fewer) and meets_noise


def _hides_breakaway(moving: Finding, on_all_rows: Finding, joint: int) -> bool:
    """Return whether `moving` lacks a breakaway of `joint` (0-based) that rows at rest show.

    At rest friction is any force up to its breakaway: forces near standstill that exceed the level
    in motion are a breakaway above it, whatever law it follows.
    """
    lost = {(e.name, e.at) for e in on_all_rows.named} - moving.winner.keys
    if not any(e.key in lost for e in _friction_of(on_all_rows.winner, joint)):
        return False
    return force_at_standstill(on_all_rows.rows.train, moving.winner, joint) > TRACE.breakaway_ratio


def _breakaway_notes(moving: Finding, on_all_rows: Finding, joints: Collection[int]) -> list[str]:
    """Return a note on each of `joints` (0-based) with a breakaway that the set lacks."""
    out = []
    for joint in sorted(joints):
        if any(e.beside for e in _friction_of(moving.winner, joint)):
            continue
        ratio = force_at_standstill(on_all_rows.rows.train, moving.winner, joint)
        if ratio > TRACE.breakaway_ratio:
            out.append(
                f"{equation('torque', joint)}: near standstill friction reaches {ratio:.2g} times "
                "the level in motion: a breakaway above it, whose law these records do not show"
            )
    return out


def force_at_standstill(data: RegressionData, winner: Hypothesis, joint: int) -> float:
    """Return the ratio of friction near standstill to the level that a set has in motion.

    In rows `data` of all samples at which `joint` (0-based) is slower than `TRACE.breakaway_speed`
    times its rms speed, friction is the residual of the set's other terms, less three times the
    noise. The result is its quantile 1 - `TRACE.breakaway_rows`, and 0 where the set's friction has
    no level, since it is proportional to a pressure or the speed.
    """
    of_friction = [c for e in _friction_of(winner, joint) for c in e.coefficients(data.rig)]
    if any(c.unit != force_unit(data.rig, joint) for c in of_friction):
        return 0.0
    rows = design_matrix(data, winner.fit.terms)
    names = [c.parameter for c in of_friction]
    levels = np.array([winner.fit.beta[name] for name in names])
    friction = rows.matrix[:, [rows.names.index(name) for name in names]] @ levels
    force = np.abs(rows.residual(winner.fit.beta) + friction)
    ratios = []
    for s in data.segments:
        if s.equation != equation("torque", joint):
            continue
        conditioned, rows_of_balance = data.source(s)
        signals, at = conditioned.signals, conditioned.samples_at(rows_of_balance.time)
        speed = np.abs(signals.sd[at, joint])
        slow = speed < TRACE.breakaway_speed * float(np.sqrt(np.mean(speed**2)))
        lever = np.abs(signals.G[at, joint]) * np.sqrt(s.repeats) / s.noise
        ratios.append(((force[s.where] - 3.0) / (float(np.sum(np.abs(levels))) * lever))[slow])
    all_ratios = np.concatenate(ratios)
    return float(np.quantile(all_ratios, 1.0 - TRACE.breakaway_rows)) if len(all_ratios) else 0.0


def _friction_in(winner: Hypothesis) -> list[Effect]:
    """Return the friction effects of a set."""
    return [e for e in effects_among(winner.effects) if e.family == "friction"]


def _friction_of(winner: Hypothesis, joint: int) -> list[Effect]:
    """Return the friction effects of a set at a joint (0-based)."""
    return [e for e in _friction_in(winner) if e.joint == joint]


def equations_above_noise(rows: TraceRows, winner: Hypothesis) -> set[str]:
    """Return the equations whose choosing rows keep more than `TRACE.noted_ratio` noise floors."""
    ratios = held_out_ratios(rows, winner)
    return {e for e, ratio in ratios.items() if ratio > TRACE.noted_ratio}


def held_out_ratios(rows: TraceRows, winner: Hypothesis) -> dict[str, float]:
    """Return the error of a set in the choosing rows over the noise floor, by equation."""
    choosing = rows.choosing
    return held_out.error_over_floor(choosing, held_out_residual(choosing, winner.fit))


def joints_with_friction(winner: Hypothesis, equations: Collection[str]) -> set[int]:
    """Return the joints (0-based) in whose torque balance, one of `equations`, friction acts."""
    return {e.joint for e in _friction_in(winner) if equation("torque", e.joint) in equations}


def rest_phase_notes(joints: Iterable[int], included: bool) -> list[str]:
    """Return a note for each joint (0-based) whose samples at rest were not judged.

    `included`: the stated errors include these samples.
    """
    errors = "include them" if included else "leave them out"
    return [
        f"{equation('torque', joint)}: {WITHOUT_RESTS}, where dry friction is whatever holds it; "
        f"the errors {errors}"
        for joint in sorted(joints)
    ]
