"""What is found on all rows, and in motion only where rests hide the law of friction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.base import Effect
from analysis.terms.base import Used, equation
from analysis.trace.data.conditioned_record import conditioned_records, moving_filtering
from analysis.trace.finding import (
    Finding,
    TraceRows,
    TraceRuns,
    finding_of,
    judge_winner,
    remainder_notes,
    search_and_judge,
    trace_rows,
    without_unnamed_effects,
)
from analysis.trace.judge import gates
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.judge.unlocked import judged_line
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, JudgedEffect
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.rig import Rig


def find(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, rows: TraceRows,
    candidates: Sequence[Effect], free: Sequence[Effect], seed: int, done: Callable[[float], None],
) -> Finding:  # fmt: skip
    """Return what the model lacks: `search_and_judge`, in motion only where that is needed.

    Torques at `records.lines` are judged beside the effects found. Where one is refused, nothing is
    taken out of the rows, and all is searched again.
    """
    found = search_and_judge(rows, candidates, free, seed, done)
    found = without_unnamed_effects(
        searched_in_motion(rig, terms, records, candidates, free, seed, found)
    )
    if not records.lines:
        return found
    judged = _judged_lines(rig, records, found)
    refused = gates.refused_effects(judged)
    if refused:
        whole = replace(records, lines=())
        rows = trace_rows(rig, terms, whole)
        found = find(rig, terms, whole, rows, candidates, free, seed, done)
        return replace(found, effects=(*found.effects, *refused))
    verdict = EXPLAINED if found.verdict == CLEAN else found.verdict
    return replace(found, effects=(*found.effects, *judged), verdict=verdict)


def _judged_lines(rig: Rig, records: TraceRuns, found: Finding) -> tuple[JudgedEffect, ...]:
    """Return the torques at `records.lines` with their gates, beside the effects found."""
    unseen, fit = found.rows.unseen, found.winner.fit
    train, holdout = (
        conditioned_records(rig, runs, families=records.families)
        for runs in (records.train, records.holdout)
    )
    judged = []
    for line in records.lines:
        own = [s for s in unseen.choosing.segments if s.equation == equation("torque", line[0])]
        noise = float(np.sqrt(np.mean([s.noise**2 for s in own]))) if own else np.inf
        judged.append(judged_line(rig, line, fit, train, holdout, unseen.divided, noise))
    return tuple(judged)


def searched_in_motion(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, candidates: Sequence[Effect],
    free: Sequence[Effect], seed: int, finding: Finding,
) -> Finding:  # fmt: skip
    """Search friction again in rows weighted by speed, where only torque balances keep too much.

    While a joint rests, dry friction is any force up to its breakaway: no law of the speed meets
    these rows, and they hide the law in motion. Candidates are friction in the torque balances that
    keep too much, named forms before `free` curves, beside the other effects of `finding`. The
    result is used if friction acts in each joint whose rows are weighted, and the set removes most
    of the energy of all rows, rests included; else `finding` is returned.

    An explanation whose friction leaves a held-out error above `TRACE.noted_ratio` noise floors is
    searched again too, and replaced where less than that remains in motion: the rests caused it.
    """
    friction = [e for e in (*candidates, *free) if e.family == "friction"]
    loud, joints = _loud_joints(finding, friction)
    if not joints:
        return finding
    named = [u.term for u in finding.winner.effects if isinstance(u.term, Effect)]

    def searched(joints: Collection[int]) -> Finding:
        rows = trace_rows(rig, terms, records, moving_filtering(joints))
        others = [e for e in named if e.family != "friction" or e.joint not in joints]
        tried = [*others, *(e for e in friction if e.joint in joints)]
        return _search_few(rows, tried, seed, rest_phase_notes(joints, "leave out"))

    found = searched(joints)
    acting = joints_with_friction(found.winner, loud)
    if acting and acting != joints:  # an effect of several balances had spread friction to others
        found = searched(acting)
    explains = found.verdict in (EXPLAINED, CONFOUNDED)
    if not explains or not acting or joints_with_friction(found.winner, loud) != acting:
        return finding
    if finding.verdict != UNEXPLAINED and not _meets_noise(found, acting):
        return finding
    on_all_rows = finding.hypotheses.refined(found.winner.effects)
    if on_all_rows.total / finding.hypotheses.empty.total > 1.0 - TRACE.least_removed:
        return finding
    failed = tuple(f for f in finding.effects if not gates.passes_gates(f))
    return replace(found, effects=(*found.effects, *failed))


def _loud_joints(finding: Finding, friction: Sequence[Effect]) -> tuple[set[str], set[int]]:
    """Return the equations that keep too much, and the joints (0-based) whose friction they show.

    No joints where an unexplained residual lies elsewhere too.
    """
    if finding.verdict == UNEXPLAINED:
        loud = {r.equation for r in finding.remainders if r.veto}
        joints = {e.joint for e in friction if equation("torque", e.joint) in loud}
        return loud, joints if {equation("torque", i) for i in joints} == loud else set()
    names = {e.name for e in friction}
    tied = {r.name for f in finding.effects for r in f.rivals if r.tied}
    if finding.verdict == CLEAN or not tied <= names:  # other rivals would not be searched again
        return set(), set()
    ratios = _held_out_ratios(finding.rows, finding.winner)
    loud = {e for e, ratio in ratios.items() if ratio > TRACE.noted_ratio}
    return loud, joints_with_friction(finding.winner, loud)


def _meets_noise(found: Finding, joints: Collection[int]) -> bool:
    """Return whether a finding leaves little over the noise in the torque balances of `joints`."""
    ratios = _held_out_ratios(found.rows, found.winner)
    return all(ratios[equation("torque", joint)] <= TRACE.noted_ratio for joint in joints)


def _held_out_ratios(rows: TraceRows, winner: Hypothesis) -> dict[str, float]:
    """Return the error of a set in the choosing rows over the noise floor, by equation."""
    choosing = rows.unseen.choosing
    return gates.error_over_floor(choosing, held_out_residual(choosing, winner.fit))


def _search_few(
    rows: TraceRows, candidates: Sequence[Effect], seed: int, notes: Sequence[str]
) -> Finding:
    """Search and judge a few candidates, free forms last; `notes` are put before those of it."""
    hypotheses = HypothesisSet(rows.train, [e for e in candidates if not e.free])
    free = [e for e in candidates if e.free]
    rng = np.random.default_rng(seed)
    found = judge_winner(hypotheses, hypotheses.run(), free, rows.unseen.choosing, rng)
    more = remainder_notes(found.verdict, found.remainders, quiet=False, named=True)
    return finding_of(rows, found, (*notes, *more))


def joints_with_friction(winner: Hypothesis, equations: Collection[str]) -> set[int]:
    """Return the joints (0-based) in whose torque balance, one of `equations`, friction acts."""
    return {
        used.term.joint
        for used in winner.effects
        if isinstance(used.term, Effect)
        and used.term.family == "friction"
        and equation("torque", used.term.joint) in equations
    }


def fitted_in_motion(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, winner: Hypothesis, joints: Iterable[int]
) -> tuple[TraceRows, HypothesisSet, Hypothesis]:
    """Return rows that are weighted by the speed of `joints` (0-based), and the set fitted to them.

    The middle element is the collection of sets that the fitted set belongs to.
    """
    rows = trace_rows(rig, terms, records, moving_filtering(joints))
    hypotheses = HypothesisSet(rows.train, [])
    return rows, hypotheses, hypotheses.refined(winner.effects)


def rest_phase_notes(joints: Iterable[int], errors: str) -> list[str]:
    """Return a note for each joint (0-based) whose samples at rest were not judged.

    `errors` says whether the stated errors "include" or "leave out" these samples.
    """
    return [
        f"{equation('torque', joint)}: judged without the samples at which the joint rests, where "
        f"dry friction is whatever holds it; the errors {errors} them"
        for joint in sorted(joints)
    ]
