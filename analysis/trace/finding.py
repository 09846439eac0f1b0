"""What is found on given rows: the search, the gates, free forms, and rests of dry friction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.effects.base import Effect
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Filtering
from analysis.terms.base import Used, equation
from analysis.trace.data.conditioned_record import (
    conditioned_records,
    moving_filtering,
    trace_filtering,
)
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import Unseen, set_aside
from analysis.trace.data.spool_path import path_terms
from analysis.trace.free_forms import drawn_by_data, mechanisms
from analysis.trace.judge import gates, readings
from analysis.trace.remaining import Rest, left_over
from analysis.trace.result import (
    CLEAN,
    CONFOUNDED,
    EXPLAINED,
    UNEXPLAINED,
    JudgedEffect,
)
from analysis.trace.search.hypothesis import Hypothesis, within
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig

ELSEWHERE = (
    "the training records are met to within the noise, the held-out ones are not: train on "
    "records with as much excitation as the held-out ones"
)


@dataclass(frozen=True)
class TraceRuns:
    """Runs by what they are for, and the families of rows that are looked at."""

    train: tuple[Run, ...]
    holdout: tuple[Run, ...]
    judge: tuple[Run, ...]
    families: tuple[str, ...]


@dataclass(frozen=True)
class TraceRows:
    """Rows that are fitted, and rows that the fit does not see."""

    train: RegressionData
    unseen: Unseen

    @property
    def in_motion(self) -> tuple[int, ...]:
        """The joints (0-based) whose rests do not count."""
        return self.train.records[0].filtering.in_motion


@dataclass(frozen=True)
class Finding:
    """What was found on some rows: every effect judged, the set that stands, its verdict."""

    rows: TraceRows
    hypotheses: HypothesisSet
    winner: Hypothesis
    verdict: str
    effects: tuple[JudgedEffect, ...] = ()
    rest: tuple[Rest, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def named(self) -> tuple[JudgedEffect, ...]:
        """The effects that stand."""
        return tuple(f for f in self.effects if _listed(f, self.verdict))

    @property
    def refused(self) -> tuple[JudgedEffect, ...]:
        """The effects that fitted best and are not named."""
        tied = [f for f in self.effects if gates.stands(f) and not _listed(f, self.verdict)]
        return (*gates.refused(self.effects), *tied)


def trace_rows(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns,
    filtering: Callable[[Record], Filtering] = trace_filtering,
) -> TraceRows:  # fmt: skip
    """Lay out all rows under the filters of each record."""

    def conditioned(runs: Sequence[Run]) -> list[ConditionedRecord]:
        return conditioned_records(rig, runs, filtering, records.families)

    train_data = _laid_out(rig, terms, conditioned(records.train))
    terms, beta = train_data.terms, train_data.beta
    members = conditioned(records.holdout)
    data = regression_data(rig, terms, members, beta)
    if not records.judge:
        return TraceRows(train_data, set_aside(data, members, records.holdout))
    members = conditioned(records.judge)
    judging = regression_data(rig, terms, members, beta)
    return TraceRows(train_data, Unseen(data, judging, tuple(members), records.holdout))


def found_on(
    rows: TraceRows, candidates: Sequence[Effect], free: Sequence[Effect], seed: int,
    done: Callable[[float], None],
) -> Finding:  # fmt: skip
    """Search on the rows and judge what is found; `done` receives the share of the columns."""
    hypotheses, holdout_data = HypothesisSet(rows.train, candidates), rows.unseen.choosing
    quiet = within(hypotheses.empty.excess_energy, hypotheses.limits)
    if quiet and not gates.remaining(hypotheses, hypotheses.empty, holdout_data):
        return Finding(rows, hypotheses, hypotheses.empty, CLEAN)
    winner = hypotheses.run(done)
    hypotheses, effects, winner, verdict, rest = _settled(
        hypotheses, winner, free, holdout_data, np.random.default_rng(seed)
    )
    named = any(map(gates.stands, effects))
    notes = _rest_notes(verdict, rest, quiet, named)
    return Finding(rows, hypotheses, winner, verdict, effects, tuple(rest), tuple(notes))


def without_tied(finding: Finding) -> Finding:
    """Drop the effects that are not named from the set that stands."""
    named = {(f.name, f.at) for f in finding.named}
    hypotheses, winner = finding.hypotheses, finding.winner
    kept = [u for u in winner.effects if (u.term.name, u.term.where) in named]
    if len(kept) == len(winner.effects):
        return finding
    winner = hypotheses.exact(kept) if kept else hypotheses.empty
    rest = left_over(hypotheses, winner, finding.rows.unseen.choosing) if kept else []
    notes = _rest_notes(finding.verdict, rest, quiet=False, named=bool(kept))
    return replace(finding, winner=winner, rest=tuple(rest), notes=tuple(notes))


def _listed(effect: JudgedEffect, verdict: str) -> bool:
    """Return whether an effect is named: it stands, and beside an unknown one without a rival."""
    return gates.stands(effect) and not (verdict == UNEXPLAINED and _tied([effect]))


def without_rests(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, candidates: Sequence[Effect],
    free: Sequence[Effect], seed: int, finding: Finding,
) -> Finding:  # fmt: skip
    """Search friction again without the joints' rests where only torque balances keep much.

    At rest dry friction is whatever holds the joint: what stays there speaks against no law of the
    speed, and hides the law in motion. Candidates are friction in these balances, named ones before
    `free` curves, beside what else stood. It must act in each of them that is looked at without
    rests, and take most of what the rests leave too.
    """
    loud = {r.equation for r in finding.rest if r.veto}
    friction = [e for e in (*candidates, *free) if e.family == "friction"]
    joints = {e.joint for e in friction if equation("torque", e.joint) in loud}
    if finding.verdict != UNEXPLAINED or {equation("torque", i) for i in joints} != loud:
        return finding
    others = [u.term for u in finding.winner.effects if isinstance(u.term, Effect)]
    others = [e for e in others if e.family != "friction"]

    def searched(joints: Collection[int]) -> Finding:
        rows = trace_rows(rig, terms, records, moving_filtering(joints))
        here = [*others, *(e for e in friction if e.joint in joints)]
        return _searched(rows, here, seed, at_rest(joints, "leave out"))

    found = searched(joints)
    acts = dry(found.winner, loud)
    if acts and acts != joints:  # a parameter of several balances took friction into others
        found = searched(acts)
    if found.verdict not in (EXPLAINED, CONFOUNDED) or dry(found.winner, loud) != acts or not acts:
        return finding
    every = finding.hypotheses.exact(found.winner.effects).total / finding.hypotheses.empty.total
    if every > 1.0 - TRACE.least_removed:
        return finding
    fallen = tuple(f for f in finding.effects if not gates.stands(f))
    return replace(found, effects=(*found.effects, *fallen))


def _searched(
    rows: TraceRows, candidates: Sequence[Effect], seed: int, notes: Sequence[str]
) -> Finding:
    """Search among a few candidates, free ones last; `notes` come first."""
    hypotheses = HypothesisSet(rows.train, [e for e in candidates if not e.free])
    hypotheses, effects, winner, verdict, rest = _settled(
        hypotheses, hypotheses.run(), [e for e in candidates if e.free], rows.unseen.choosing,
        np.random.default_rng(seed),
    )  # fmt: skip
    notes = (*notes, *_rest_notes(verdict, rest, quiet=False, named=True))
    return Finding(rows, hypotheses, winner, verdict, effects, tuple(rest), notes)


def dry(winner: Hypothesis, equations: Collection[str]) -> set[int]:
    """Return the joints (0-based) with dry friction of the set in one of some torque balances."""
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
    """Return rows that do not count the rests of some joints, and the set's effects fitted."""
    rows = trace_rows(rig, terms, records, moving_filtering(joints))
    hypotheses = HypothesisSet(rows.train, [])
    return rows, hypotheses, hypotheses.exact(winner.effects)


def at_rest(joints: Iterable[int], errors: str) -> list[str]:
    """Return a note for each joint (0-based) whose samples at rest were not counted.

    `errors` is what the errors do with them: "include" or "leave out".
    """
    return [
        f"{equation('torque', joint)}: judged without the samples at which the joint rests, where "
        f"dry friction is whatever holds it; the errors {errors} them"
        for joint in sorted(joints)
    ]


def _laid_out(
    rig: Rig, terms: tuple[Used, ...], train: Sequence[ConditionedRecord]
) -> RegressionData:
    """Lay out the training records, spools' paths between samples beside the terms."""
    data = regression_data(rig, terms, train)
    _refuse_short(data)
    paths = path_terms(data)
    return regression_data(rig, (*terms, *paths), train) if paths else data


def _refuse_short(train_data: RegressionData) -> None:
    for s in train_data.segments:
        count = s.where.stop - s.where.start
        if count < TRACE.least_rows:
            conditioned, rows = train_data.source(s)
            record, masked = conditioned.record, rows.masked
            remedy = "take longer records"
            if masked > count:
                remedy = (
                    f"{masked} others are masked, since a pressure lies outside 0 to the supply's, "
                    "or samples were clipped or lost: move less, or check the sensors' ranges"
                )
            raise InputError(
                f"step {s.group[1]!r}: records of {record.samples / record.sample_rate:.3g} s "
                f"leave {count} rows of {s.equation}; the trace needs {TRACE.least_rows}: {remedy}"
            )


def _drawn(
    hypotheses: HypothesisSet, free: Sequence[Effect], winner: Hypothesis, verdict: str,
    holdout_data: RegressionData, rng: np.random.Generator,
) -> tuple[HypothesisSet, tuple[JudgedEffect, ...], Hypothesis, list[Rest]] | None:  # fmt: skip
    """Try free mechanisms where no name explains, or only several with more than noise left."""
    fewer = verdict != UNEXPLAINED
    if fewer and (mechanisms(winner) < 2 or within(winner.excess_energy, hypotheses.limits)):
        return None
    return drawn_by_data(hypotheses, free, winner, holdout_data, rng, fewer)


def _settled(
    hypotheses: HypothesisSet, winner: Hypothesis, free: Sequence[Effect],
    holdout_data: RegressionData, rng: np.random.Generator,
) -> tuple[HypothesisSet, tuple[JudgedEffect, ...], Hypothesis, str, list[Rest]]:  # fmt: skip
    """Judge what the search has found, names first, then free forms.

    Returns the sets tried, what was judged, the set that stands, the verdict and what it leaves.
    """
    winner = readings.settled(hypotheses, winner, holdout_data)
    effects, winner, verdict, rest = _named(hypotheses, winner, holdout_data, rng)
    drawn = _drawn(hypotheses, free, winner, verdict, holdout_data, rng)
    if drawn is not None:
        hypotheses, effects, winner, rest = drawn
        verdict = CONFOUNDED if _tied(effects) else EXPLAINED
    elif verdict == UNEXPLAINED:
        effects += _unphysical(hypotheses, holdout_data, rng)
    return hypotheses, effects, winner, verdict, rest


def _unphysical(
    hypotheses: HypothesisSet, holdout_data: RegressionData, rng: np.random.Generator
) -> tuple[JudgedEffect, ...]:
    """Return what physics alone refuses of the simplest set that would leave next to nothing."""
    near = [o for o in hypotheses.fitted.values() if hypotheses.formed(o) and o.effects]
    near = [o for o in near if hypotheses.physical(o)]
    if not near:
        return ()
    best = min(near, key=lambda o: (o.size[1], o.total))
    effects = gates.judge(hypotheses, best, holdout_data, rng)
    # What else fits is no matter where physics refuses.
    asked = [
        replace(f, gates=tuple(g for g in f.gates if g.name in (gates.REMOVES, gates.PHYSICAL)))
        for f in effects
    ]
    return tuple(replace(f, rivals=()) for f in asked if not gates.stands(f))


def _rest_notes(verdict: str, rest: Sequence[Rest], quiet: bool, named: bool) -> list[str]:
    """State what stays, and whether it speaks against what was found."""
    out = [ELSEWHERE] if quiet and verdict == UNEXPLAINED else []
    if verdict == UNEXPLAINED and (named or quiet):
        out += [f"{r.equation}: {r.words}" for r in rest if r.veto]
    return [*out, *(f"{r.equation}: {r.words}" for r in rest if not r.veto)]


def _named(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    holdout_data: RegressionData,
    rng: np.random.Generator,
) -> tuple[tuple[JudgedEffect, ...], Hypothesis, str, list[Rest]]:
    """Put the winner through the gates.

    Returns what was judged, the set that stands, the verdict, and the equations that keep more than
    is nothing, each with what it keeps.
    """
    effects: tuple[JudgedEffect, ...] = ()
    refused: tuple[JudgedEffect, ...] = ()
    # What stands beside others may fall without them: judged again until all that is left stands.
    while winner.effects:
        effects = gates.judge(hypotheses, winner, holdout_data, rng)
        fallen = tuple(f for f in effects if not gates.stands(f))
        if not fallen:
            break
        refused += fallen
        smaller = [u for u, f in zip(winner.effects, effects, strict=True) if gates.stands(f)]
        if not smaller:
            return (
                refused,
                hypotheses.empty,
                UNEXPLAINED,
                left_over(hypotheses, hypotheses.empty, holdout_data),
            )
        winner = hypotheses.exact(smaller)
    rest = left_over(hypotheses, winner, holdout_data)
    while rest:
        more = hypotheses.closer(winner, {r.equation for r in rest})
        wider = gates.judge(hypotheses, more, holdout_data, rng) if more else ()
        later = left_over(hypotheses, more, holdout_data) if more else rest
        # What speaks against nothing is named only if nothing else fits as well.
        needed = any(r.veto for r in rest) or _tied(wider) == _tied(effects)
        stand = needed and all(map(gates.stands, wider))
        if more is None or len(later) >= len(rest) or not stand:
            break
        effects, winner, rest = wider, more, later
    if any(r.veto for r in rest):
        return (*effects, *refused), winner, UNEXPLAINED, rest
    if not winner.effects:  # what is left is too little for any effect to be needed
        return refused, winner, CLEAN, rest
    return effects, winner, CONFOUNDED if _tied(effects) else EXPLAINED, rest


def _tied(effects: Sequence[JudgedEffect]) -> bool:
    """Whether another effect fits as well as one of those found."""
    return any(r.tied for f in effects for r in f.rivals)
