"""The trace: residual -> effect -> model with the effect -> error before and after."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, ordered
from analysis.identify import checks as ck
from analysis.identify.estimators.nuisance import BulkTemperature, SpoolPath
from analysis.identify.geometry import NAME as GEOMETRY
from analysis.identify.geometry import wider
from analysis.identify.identify import identify
from analysis.identify.result import Identification, by_geometry
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Filtering, default_filtering
from analysis.simulation.model import Model
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, equation
from analysis.trace.data.candidates import catalogue, free_mechanisms
from analysis.trace.data.conditioned_record import (
    conditioned_records,
    moving_filtering,
    trace_filtering,
)
from analysis.trace.data.noise_floor import NEIGHBOURS, PERIODS, REPEATS, STATED
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import Unseen, set_aside
from analysis.trace.data.spectral_lines import lines
from analysis.trace.data.spool_path import path_terms
from analysis.trace.data.temperature_nuisance import stripped, temperature_terms
from analysis.trace.free_forms import drawn_by_data, mechanisms
from analysis.trace.judge import gates, held_out, readings
from analysis.trace.judge.curves import beyond_in_words, within_curves
from analysis.trace.judge.scatter import widened
from analysis.trace.judge.shooting import reshaped, with_shots
from analysis.trace.next_experiment.detection_limits import detection_limits, in_words
from analysis.trace.next_experiment.proposal import propose
from analysis.trace.remaining import Rest, clues_to, left_over
from analysis.trace.result import (
    CLEAN,
    CONFOUNDED,
    EXPLAINED,
    UNEXPLAINED,
    JudgedEffect,
    Trace,
)
from analysis.trace.search.hypothesis import Hypothesis, within
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from analysis.trace.words import sentence
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.units import plain

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# Others replace the columns where noise in them matters: the trace compares least squares alone.
ESTIMATOR = "ls"
# Shares of a trace's time behind it, as measured on six records: reported as progress.
PREPARED, COLUMNS, JUDGED = 0.1, 0.55, 0.8
ELSEWHERE = (
    "the training records are met to within the noise, the held-out ones are not: train on "
    "records with as much excitation as the held-out ones"
)


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
) -> Trace:
    """Say what the baseline lacks on `runs`, name it or refuse to, and judge it by other records.

    Records of `holdout` choose between effects and forms. Those of `judge` are read once, when all
    is settled: they give the errors, and may refuse an explanation. Without them a third of the
    held-out rows is set aside for that (`data.set_aside`).

    `effects` are the candidates, by default the whole catalogue at every place. `seed` draws the
    half-samples and sign flips; `families` are the equations looked at, mechanical or fluid (they
    share no parameter, so that what stays unexplained in one need not hide the other); `look_ahead`
    designs the next experiment; `terms` take the baseline's place: a model's with its effects,
    whose shapes stay as they are; with `free_forms` a mechanism whose curve the data draw may
    explain what no named effect does; `progress` receives the share of the work done. Raises
    InputError for records of different rigs, without held-out records, with held-out or judging
    ones that have been seen before, or too short to judge by.
    """
    started = time.perf_counter()
    rig = ck.common_rig([*runs, *holdout, *judge])
    _refuse_same(runs, holdout, judge)
    known = tuple(map(Used, baseline_of(rig))) if terms is None else tuple(terms)
    terms = ordered((*known, *temperature_terms(known, runs, [*holdout, *judge])))
    records = TraceRuns(tuple(runs), tuple(holdout), tuple(judge), tuple(families))
    rows = _rows(rig, terms, records)
    moving = len({s.equation.rsplit("_", 1)[1] for s in rows.train.segments})
    candidates = _unknown(catalogue(rig) if effects is None else effects, known, moving)
    free = _unknown(free_mechanisms(rig), known) if free_forms else []
    done = progress or _nobody
    baseline = _identified(runs, rows.train.terms)
    before = baseline.model
    notes = [*rows.unseen.notes, *_notes(rows.train, rows.unseen.choosing)]
    notes += [check.detail for check in baseline.checks if check.name == GEOMETRY]
    finding = _found(rows, candidates, free, seed, done)
    finding = _without_tied(_without_rests(rig, terms, records, seed, finding))
    verdict, winner = finding.verdict, finding.winner
    judged_effects, refused = finding.named, finding.refused
    notes += finding.notes
    done(JUDGED)
    train_data, choosing = finding.rows.train, finding.rows.unseen.choosing
    split = lines(train_data, winner.fit.residual)
    moves, formulas = (
        ((), ()) if verdict in (CLEAN, EXPLAINED) else clues_to(train_data, choosing, winner, split)
    )
    hypotheses = finding.hypotheses
    further = propose(hypotheses, winner, judged_effects, verdict, moves) if look_ahead else None
    after, unknown = _extended(runs, winner, before, finding.rows)
    again = reshaped(runs, rows.unseen.choosing_runs, after, train_data, choosing, winner)
    if again.winner is not winner:
        winner = again.winner
        after, unknown = _extended(runs, winner, before, finding.rows)
        split = lines(train_data, winner.fit.residual)
    judged_effects = tuple(
        with_shots(_with_tolerances(f, unknown), again.shots) for f in judged_effects
    )
    # All is settled: from here on the judging rows are read, and nothing is chosen.
    unseen = rows.unseen
    first, last = (
        held_out.settled(unseen.judging, hypotheses.empty.fit),
        held_out.settled(unseen.judging, winner.fit),
    )
    error = held_out.errors(rig, unseen.members, first, last, unseen.divided)
    verdict, kept = _judged(rig, terms, records, finding, winner)
    hidden = (
        detection_limits(train_data, candidates, winner, after) if verdict != UNEXPLAINED else []
    )
    notes += [*kept, *_missed_held(verdict, error, [*notes, *kept]), *in_words(hidden)]
    runs_before, runs_after = held_out.free_runs([*holdout, *judge], before, after)
    result = Trace(
        verdict, judged_effects, error.noise, error.before, error.after,
        runs_before.fit, runs_after.fit, before, after,
        _fraction(hypotheses, winner), moves, further, rows.train.floors,
        first, last, tuple(notes), refused=refused, size=error.size,
        rmse_before=runs_before.rmse, rmse_after=runs_after.rmse,
        window_before=runs_before.window_rmse, window_after=runs_after.window_rmse,
        lines=split, formulas=formulas,
        free_curves=held_out.free_curves(runs_before, runs_after),
        detection_limits=tuple(hidden), seconds=time.perf_counter() - started,
    )  # fmt: skip
    return replace(result, sentence=sentence(result))


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
    def rests(self) -> bool:
        """Whether the joints' rests count."""
        return all(conditioned.filtering.rests for conditioned in self.train.records)


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


def _rows(
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


def _found(
    rows: TraceRows, candidates: Sequence[Effect], free: Sequence[Effect], seed: int,
    done: Callable[[float], None],
) -> Finding:  # fmt: skip
    """Search on the rows, and judge what is found."""
    hypotheses, holdout_data = HypothesisSet(rows.train, candidates), rows.unseen.choosing
    quiet = within(hypotheses.empty.excess_energy, hypotheses.limits)
    if quiet and not gates.remaining(hypotheses, hypotheses.empty, holdout_data):
        return Finding(rows, hypotheses, hypotheses.empty, CLEAN)
    winner = hypotheses.run(lambda share: done(PREPARED + (COLUMNS - PREPARED) * share))
    hypotheses, effects, winner, verdict, rest = _settled(
        hypotheses, winner, free, holdout_data, np.random.default_rng(seed)
    )
    named = any(map(gates.stands, effects))
    notes = _rest_notes(verdict, rest, quiet, named)
    return Finding(rows, hypotheses, winner, verdict, effects, tuple(rest), tuple(notes))


def _without_tied(finding: Finding) -> Finding:
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


def _without_rests(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, seed: int, finding: Finding
) -> Finding:
    """Ask without the joints' rests what is left where only balances with dry friction keep much.

    At rest dry friction is whatever holds the joint: what stays there speaks against no law of the
    speed. Where nothing else stays, what stood explains the records, with its sizes in motion.
    """
    loud = {r.equation for r in finding.rest if r.veto}
    if finding.verdict != UNEXPLAINED:
        return finding
    if not _dry(finding.winner, loud):
        return _drawn_in_motion(rig, terms, records, seed, finding, loud)
    rows, hypotheses, winner = _in_motion(rig, terms, records, finding.winner)
    holdout_data = rows.unseen.choosing
    rest = left_over(hypotheses, winner, holdout_data)
    judged = gates.judge(hypotheses, winner, holdout_data, np.random.default_rng(seed))
    if any(r.veto for r in rest) or not all(map(gates.stands, judged)):
        return finding
    sizes = {(f.name, f.where): f.parameters for f in judged}
    stand = [f for f in finding.effects if gates.stands(f)]
    named = [replace(f, parameters=sizes[f.name, f.where]) for f in stand]
    others = [f for f in finding.effects if not gates.stands(f)]
    verdict = CONFOUNDED if _tied(named) else EXPLAINED
    notes = (*_at_rest(loud), *_rest_notes(verdict, rest, quiet=False, named=True))
    return Finding(rows, hypotheses, winner, verdict, (*named, *others), tuple(rest), notes)


def _drawn_in_motion(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, seed: int, finding: Finding,
    loud: Collection[str],
) -> Finding:  # fmt: skip
    """Draw friction over speed without the rests where nothing that acts in torques stood.

    A high breakaway hides the law in motion from every name. The curve must take most of what the
    rests leave too.
    """
    free = [f for f in free_mechanisms(rig) if f.family == "friction"]
    free = [f for f in free if equation("torque", f.joint) in loud]
    if finding.winner.effects or not free or len(free) < len(loud):
        return finding
    rows = _rows(rig, terms, records, moving_filtering)
    hypotheses = HypothesisSet(rows.train, [])
    winner = hypotheses.run()
    rng = np.random.default_rng(seed)
    drawn = drawn_by_data(hypotheses, free, winner, rows.unseen.choosing, rng, fewer=False)
    if drawn is None:
        return finding
    hypotheses, effects, winner, rest = drawn
    every = finding.hypotheses.exact(winner.effects).total / finding.hypotheses.empty.total
    if every > 1.0 - TRACE.least_removed:
        return finding
    notes = (*_at_rest(loud), *_rest_notes(EXPLAINED, rest, quiet=False, named=True))
    others = tuple(f for f in finding.effects if not gates.stands(f))
    return Finding(rows, hypotheses, winner, EXPLAINED, (*effects, *others), tuple(rest), notes)


def _dry(winner: Hypothesis, equations: Collection[str]) -> bool:
    """Return whether dry friction of the set acts in each of some equations, at least one."""
    dry = {
        equation("torque", used.term.joint)
        for used in winner.effects
        if isinstance(used.term, Effect) and used.term.family == "friction"
    }
    return bool(equations) and dry.issuperset(equations)


def _in_motion(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, winner: Hypothesis
) -> tuple[TraceRows, HypothesisSet, Hypothesis]:
    """Return rows that do not count the joints' rests, and the set's effects fitted to them."""
    rows = _rows(rig, terms, records, moving_filtering)
    effects = [u.term for u in winner.effects if isinstance(u.term, Effect)]
    hypotheses = HypothesisSet(rows.train, effects)
    hypotheses.run()
    return rows, hypotheses, hypotheses.exact(winner.effects)


def _at_rest(equations: Collection[str]) -> list[str]:
    return [
        f"{e}: judged without the samples at which the joint rests, where dry friction is whatever "
        "holds it; the errors include them"
        for e in sorted(equations)
    ]


def _laid_out(
    rig: Rig, terms: tuple[Used, ...], train: Sequence[ConditionedRecord]
) -> RegressionData:
    """Lay out the training records, spools' paths between samples beside the terms."""
    data = regression_data(rig, terms, train)
    _refuse_short(data, train)
    paths = path_terms(data)
    return regression_data(rig, (*terms, *paths), train) if paths else data


def _nobody(_: float) -> None:
    """Hear nothing."""


def _refuse_same(runs: Sequence[Run], holdout: Sequence[Run], judge: Sequence[Run] = ()) -> None:
    if not holdout or not any(run.records for run in holdout):
        raise InputError(
            "no held-out records: give --holdout a run that is not used for the fit, with another "
            "excitation (other wave or amplitude)"
        )
    if judge and not any(run.records for run in judge):
        raise InputError("no judging records: the runs of --judge are empty")
    seen: dict[str, str] = {}
    for kind, option, given in (
        ("training", "", runs), ("held-out", "--holdout", holdout), ("judging", "--judge", judge),
    ):  # fmt: skip
        digests = [(_digest(record), record.name) for run in given for record in run.records]
        for digest, name in digests if option else ():
            if digest in seen:
                raise InputError(
                    f"{kind} record {name!r} is {seen[digest]}, sample for sample; it must not be "
                    f"used twice: give {option} other records"
                )
        seen |= {digest: f"{kind} record {name!r}" for digest, name in digests}


def _digest(record: Record) -> str:
    """Return a digest of a record's samples; what it is called does not matter."""
    digest = hashlib.sha256()
    for name in sorted(record.channels):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(record.channels[name], dtype=np.float64).tobytes())
    return digest.hexdigest()


def _judged(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, finding: Finding, winner: Hypothesis
) -> tuple[str, list[str]]:
    """Return the verdict of the rows that judge, and in words what these keep or cannot show."""
    if finding.verdict == UNEXPLAINED:
        return UNEXPLAINED, []
    kept, words = _kept(finding.rows.unseen.judging, finding.hypotheses.empty, winner)
    if finding.rows.rests and _dry(winner, kept):
        rows, hypotheses, moving = _in_motion(rig, terms, records, winner)
        if not _kept(rows.unseen.judging, hypotheses.empty, moving)[0]:
            kept, words = set(), _at_rest(kept)
    return (UNEXPLAINED if kept else finding.verdict), words


def _kept(
    judge_data: RegressionData, before: Hypothesis, after: Hypothesis
) -> tuple[set[str], list[str]]:
    """Return the equations of which judging rows keep too much, and it all in words."""
    known = within_curves(judge_data, after.fit)
    kept = gates.remaining_held_out(known, before.fit, after.fit)
    words = [f"{e}: {figure} in the records that judge" for e, figure in kept]
    return {e for e, _ in kept}, [*words, *beyond_in_words(judge_data, known)]


def _refuse_short(train_data: RegressionData, train: Sequence[ConditionedRecord]) -> None:
    for s in train_data.segments:
        count = s.where.stop - s.where.start
        if count < TRACE.least_rows:
            record = next(x.record for x in train if x.group == s.group)
            k = [x.group for x in train_data.records].index(s.group)
            masked = train_data.rows[k][s.equation].masked
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


def _notes(train_data: RegressionData, holdout_data: RegressionData) -> list[str]:
    """State where the evidence is weaker than it should be."""
    out = []
    sources = {f.source for f in train_data.floors}
    single = sorted({f.group[1] for f in train_data.floors if f.source == STATED})
    if single:
        out.append(
            f"one repeat of {' '.join(single)} and no whole periods to compare: the noise floor is "
            "the rig file's stated sensor noise; noise above that value would be taken "
            "for model error, so the evidence for every name is weaker"
        )
    elif sources != {REPEATS}:
        where = PERIODS if PERIODS in sources else NEIGHBOURS
        out.append(f"one repeat per step: the noise floor comes from {where} within the record")
    few = min((f.count for f in train_data.floors if f.count > 1), default=0)
    if 0 < few < 4:
        out.append(
            f"{few} repeats: stability is judged on few half-samples; use four repeats or more"
        )
    if all(f.source == STATED for f in holdout_data.floors):
        out.append("the held-out noise floor is the rig file's stated sensor noise")
    return out


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
    # What half-samples choose, or what else fits, is no matter where physics refuses.
    asked = [
        replace(f, gates=tuple(g for g in f.gates if g.name in (gates.REMOVES, gates.PHYSICAL)))
        for f in effects
    ]
    return tuple(replace(f, rivals=()) for f in asked if not gates.stands(f))


def _missed_held(verdict: str, error: held_out.Errors, failures: Sequence[str]) -> list[str]:
    """State what an explanation leaves in held-out records where nothing has been said of it."""
    if verdict not in (EXPLAINED, CONFOUNDED):
        return []
    out = []
    for e, noise in error.noise.items():
        if error.after[e] > TRACE.noted_ratio * noise and not any(
            n.startswith(f"{e}:") for n in failures
        ):
            share = (error.after[e] ** 2 - noise**2) / max(error.before[e] ** 2 - noise**2, 1e-30)
            out.append(
                f"{e}: held-out error {error.after[e] / noise:.2f} times the noise floor, "
                f"{plain(100 * share, 2)} % of the baseline's energy, within "
                "the tolerance for the form of the named effect"
            )
    return out


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


def _fraction(hypotheses: HypothesisSet, winner: Hypothesis) -> float:
    """Return the share of the training records' repeatable energy that is left."""
    start = hypotheses.empty.total
    return float(min(1.0, winner.total / start)) if start > 0 else 0.0


def _unknown(candidates: Sequence[Effect], known: Sequence[Used], moving: int = 1) -> list[Effect]:
    """Return the candidates that are not in the model, and are something where so many move."""
    there = {(u.term.name, u.term.where) for u in known}
    fresh = [c for c in candidates if (c.name, c.where) not in there]
    return [c for c in fresh if c.least_joints <= moving]


def _extended(
    runs: Sequence[Run], winner: Hypothesis, before: Model, rows: TraceRows
) -> tuple[Model, dict[str, float]]:
    """Identify everything again together with the effects, their shapes' errors included.

    Also returns the part of each standard error that the rig's tolerances make, by name.
    """
    if not winner.effects:
        return before, {}
    train_data = rows.train
    found = _identified(runs, (*train_data.terms, *winner.effects), rows.rests)
    return stripped(widened(train_data, winner.fit, found.model)), by_geometry(found)


def _identified(runs: Sequence[Run], terms: Sequence[Used], rests: bool = True) -> Identification:
    """Identify a model's parameters; what acts beside it is fitted by the estimator itself."""
    beside = (BulkTemperature, SpoolPath)
    own = ordered([u for u in terms if not isinstance(u.term, beside)])

    def filtering(record: Record) -> Filtering:
        return replace(default_filtering(record), rests=rests)

    return identify(runs, terms=own, filtering=filtering, estimator=ESTIMATOR)


def _with_tolerances(effect: JudgedEffect, unknown: Mapping[str, float]) -> JudgedEffect:
    """Return an effect whose intervals include the rig's tolerances; its shapes' are as before."""
    parameters = {
        name: wider(estimate, unknown[name]) if name in unknown else estimate
        for name, estimate in effect.parameters.items()
    }
    return replace(effect, parameters=parameters)
