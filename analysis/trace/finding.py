"""What is found on given rows: search, gates, free forms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in
from analysis.trace.data.noise_floor import STATED
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.trace_rows import TraceRows, TraceRuns, trace_rows
from analysis.trace.data.unrepeated import unrepeated_floors
from analysis.trace.free_forms import explained_by_free_form
from analysis.trace.judge import gates, readings
from analysis.trace.judge.rivals import best_tied_set
from analysis.trace.judge.unknown_cause import judged_beside_unknown_cause
from analysis.trace.judgement import Judgement, has_tied_rival
from analysis.trace.remaining import Remainder, clues_to, remainders
from analysis.trace.result import (
    CLEAN,
    CONFOUNDED,
    EXPLAINED,
    UNEXPLAINED,
    Gate,
    JudgedEffect,
)
from analysis.trace.search.exact_trials import improved_by_exact_trials
from analysis.trace.search.hypothesis import Hypothesis, effect_of, within_band
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import DATA, SEARCH
from rig.model.rig import Rig

Array = NDArray[np.float64]

ONLY_HELD_OUT_MISSED = (
    "the training records are met to within the noise, the held-out ones are not: train on "
    "records with as much excitation as the held-out ones; if these have it, the machine has "
    "changed between the runs: train on records taken after the change to trace it"
)


@dataclass(frozen=True)
class Finding:
    """The answer on some rows: judged effects, the set of those that passed, and the verdict.

    `held_out_only`: the training rows hold nothing above the noise, in contrast to held-out rows.
    """

    rows: TraceRows
    hypotheses: HypothesisSet
    winner: Hypothesis
    verdict: str
    effects: tuple[JudgedEffect, ...] = ()
    remainders: tuple[Remainder, ...] = ()
    notes: tuple[str, ...] = ()
    held_out_only: bool = False

    @property
    def named(self) -> tuple[JudgedEffect, ...]:
        """The effects that are named."""
        return tuple(f for f in self.effects if _is_named(f, self.verdict))

    @property
    def refused(self) -> tuple[JudgedEffect, ...]:
        """The effects that fitted best and are not named."""
        tied = [f for f in self.effects if gates.passes_gates(f) and not _is_named(f, self.verdict)]
        return (*gates.refused_effects(self.effects), *tied)

    def refused_by(self, gate: Gate) -> Finding:
        """Return the finding without names: every effect fails a further gate."""
        effects = tuple(replace(f, gates=(*f.gates, gate)) for f in self.effects)
        return replace(self, winner=self.hypotheses.empty, verdict=UNEXPLAINED, effects=effects)


def _is_named(effect: JudgedEffect, verdict: str) -> bool:
    """Return whether an effect is named: it passes the gates; if `unexplained`, without a tie."""
    return gates.passes_gates(effect) and not (verdict == UNEXPLAINED and has_tied_rival((effect,)))


def unstated_noise(
    rig: Rig, terms: tuple[Used, ...], records: TraceRuns, finding: Finding
) -> tuple[TraceRuns, TraceRows] | None:
    """Return runs and rows whose noise floors are what `finding` leaves, where nothing repeats.

    The stated noise may lack what a sensor has at low frequencies. Equations whose noise a step
    shows keep their floors. None where each has one, where more than `DATA.unstated_ratio` times
    the stated noise is left, where a variable of the records removes a part of that from held-out
    records, or an effect that the gates refuse.
    """
    data = finding.rows.train
    measured = {f.equation for f in data.floors if f.source != STATED}
    refused = any(map(gates.removes, gates.refused_effects(finding.effects)))
    if finding.verdict != UNEXPLAINED or refused:
        return None
    winner = _with_tied_effects(finding)
    power: dict[str, list[Array]] = {}
    for s in data.segments:  # whitened by the stated noise
        if s.equation not in measured:
            power.setdefault(s.equation, []).append(winner.fit.residual[s.where] ** 2)
    ratio = {e: float(np.sqrt(np.mean(np.concatenate(parts)))) for e, parts in power.items()}
    if not ratio or max(ratio.values()) > DATA.unstated_ratio:
        return None
    moves, formulas = clues_to(data, finding.rows.unseen.choosing, winner, ())
    if formulas or any(m.share > DATA.unstated_clue for m in moves):
        return None
    above = {name: max(1.0, value) for name, value in ratio.items()}
    records = replace(records, noise_ratio=above)
    return records, trace_rows(rig, terms, records)


def _with_tied_effects(finding: Finding) -> Hypothesis:
    """Return the set of a finding with effects that only a tied rival keeps from being named."""
    passing = [effect_of(f.name, f.at) for f in finding.effects if gates.passes_gates(f)]
    if len(passing) == len(finding.winner.effects):
        return finding.winner
    rig = finding.rows.train.rig
    return finding.hypotheses.refined([at_start(rig, effect) for effect in passing])


def search_and_judge(
    rows: TraceRows, candidates: Sequence[Effect], free: Sequence[Effect], seed: int,
    done: Callable[[float], None],
) -> Finding:  # fmt: skip
    """Search the candidates for what the model lacks and judge it on the choosing rows.

    `free` are mechanisms without a named form, tried where no named effect explains; `seed` draws
    the sign flips; `done` receives the share of the candidates' columns that is computed.
    """
    hypotheses, choosing = HypothesisSet(rows.train, candidates), rows.unseen.choosing
    in_noise = within_band(hypotheses.empty.excess_energy, hypotheses.noise_band)
    if in_noise and not gates.equations_above_band(hypotheses, hypotheses.empty, choosing):
        return Finding(rows, hypotheses, hypotheses.empty, CLEAN)
    winner = improved_by_exact_trials(hypotheses, hypotheses.run(done))
    found = judge_winner(hypotheses, winner, free, choosing, np.random.default_rng(seed))
    named = any(map(gates.passes_gates, found.effects))
    notes = remainder_notes(found.verdict, found.remainders, in_noise, named)
    if not in_noise or found.verdict != UNEXPLAINED:
        return finding_of(rows, found, notes)
    notes = [*_held_out_only_notes(rows.train, found.remainders), *notes]
    if not found.winner.effects:  # refused ones were fitted to noise
        found = replace(found, effects=())
    return replace(finding_of(rows, found, notes), held_out_only=not found.winner.effects)


def with_free_form(finding: Finding, free: Sequence[Effect], seed: int) -> Finding:
    """Return the finding, or an explanation by a free form where one is needed and explains."""
    found = Judgement(
        finding.hypotheses, finding.effects, finding.winner, finding.verdict, finding.remainders
    )
    choosing, rng = finding.rows.unseen.choosing, np.random.default_rng(seed)
    by_free_form = _try_free_forms(found, free, choosing, rng)
    if by_free_form is None:
        return finding
    notes = remainder_notes(by_free_form.verdict, by_free_form.remainders, False, True)
    return finding_of(finding.rows, by_free_form, notes)


def _held_out_only_notes(train_data: RegressionData, left: Sequence[Remainder]) -> list[str]:
    """Say why only held-out records keep too much: what does not repeat, or little excitation."""
    above = sorted({r.equation for r in left if r.veto})
    unrepeated = [e for e in above if e in unrepeated_floors(train_data)]
    out = [
        f"{e}: the training repeats differ from each other too: the cause changes with time or "
        "does not follow the excitation, and more excitation would not show it"
        for e in unrepeated
    ]
    return out if unrepeated == above else [*out, ONLY_HELD_OUT_MISSED]


def finding_of(rows: TraceRows, found: Judgement, notes: Iterable[str]) -> Finding:
    """Return the finding of a judgement on `rows`, with `notes` on what remains."""
    return Finding(
        rows, found.hypotheses, found.winner, found.verdict, found.effects, found.remainders,
        tuple(notes),
    )  # fmt: skip


def without_unnamed_effects(finding: Finding) -> Finding:
    """Return a finding whose set (`winner`) holds only the effects that are named."""
    named = {(f.name, f.at) for f in finding.named}
    hypotheses, winner = finding.hypotheses, finding.winner
    kept = [u for u in winner.effects if u.term.key in named]
    if len(kept) == len(winner.effects):
        return finding
    winner = hypotheses.refined(kept)
    left = remainders(hypotheses, winner, finding.rows.unseen.choosing) if kept else []
    notes = remainder_notes(finding.verdict, left, in_noise=False, named=bool(kept))
    return replace(finding, winner=winner, remainders=tuple(left), notes=tuple(notes))


def judge_winner(
    hypotheses: HypothesisSet, winner: Hypothesis, free: Sequence[Effect],
    holdout_data: RegressionData, rng: np.random.Generator,
) -> Judgement:  # fmt: skip
    """Judge the set that the search has found, and try free forms where it does not explain.

    Its effects are judged under the simplest names that fit, and where these do not explain, under
    other names of their laws (`_under_other_names`).
    """
    simplest = readings.best_readings(hypotheses, winner, holdout_data)
    found = _apply_gates(hypotheses, simplest, holdout_data, rng)
    if found.verdict == UNEXPLAINED:
        other = _under_other_names(hypotheses, winner, simplest, holdout_data, rng)
        found = found if other is None else other
    if found.verdict == CONFOUNDED:
        found = _with_best_tied_set(found, holdout_data, rng)
    by_free_form = _try_free_forms(found, free, holdout_data, rng)
    if by_free_form is not None:
        return by_free_form
    if found.verdict == UNEXPLAINED:
        unphysical = _refused_as_unphysical(hypotheses, holdout_data, rng)
        return replace(found, effects=(*found.effects, *unphysical))
    return found


def _under_other_names(
    hypotheses: HypothesisSet, winner: Hypothesis, simplest: Hypothesis,
    holdout_data: RegressionData, rng: np.random.Generator,
) -> Judgement | None:  # fmt: skip
    """Return an explanation by other names of the laws of a set, None if there is none.

    They are those that the search found, then both parts of a law of which one was refused: of a
    breakaway the level alone is not the same at all speeds, nor is a breakaway that stands for a
    level too.
    """
    parts = map(hypotheses.refined, hypotheses.with_parts_beside(simplest))
    for other in (winner, *sorted(parts, key=lambda o: o.total)):
        if other.keys != simplest.keys:
            found = _apply_gates(hypotheses, other, holdout_data, rng)
            if found.verdict != UNEXPLAINED:
                return found
    return None


def _with_best_tied_set(
    found: Judgement, holdout_data: RegressionData, rng: np.random.Generator
) -> Judgement:
    """Return the judgement of the best of the sets that the records cannot separate."""
    best = best_tied_set(found.hypotheses, found.winner, found.effects, holdout_data)
    if best is found.winner:
        return found
    other = _apply_gates(found.hypotheses, best, holdout_data, rng)
    all_pass = best.keys <= other.winner.keys
    return other if all_pass and other.verdict == CONFOUNDED else found


def _try_free_forms(
    found: Judgement, free: Sequence[Effect], holdout_data: RegressionData,
    rng: np.random.Generator,
) -> Judgement | None:  # fmt: skip
    """Return an explanation by a free form, None where none is needed or none explains.

    One is needed where named effects do not explain, leave more than the tolerance for their forms,
    or explain with several mechanisms and leave more than noise.
    """
    hypotheses, winner = found.hypotheses, found.winner
    explained = found.verdict != UNEXPLAINED
    if explained and not (winner.effects and _may_be_replaced(hypotheses, winner)):
        return None
    return explained_by_free_form(hypotheses, free, winner, holdout_data, rng, explained)


def _may_be_replaced(hypotheses: HypothesisSet, winner: Hypothesis) -> bool:
    """Return whether a set that explains leaves enough for a free form in its place."""
    to_noise = within_band(winner.excess_energy, hypotheses.noise_band)
    several = len(winner.laws) > 1
    return not to_noise and (several or not hypotheses.within_form_tolerance(winner))


def _refused_as_unphysical(
    hypotheses: HypothesisSet, holdout_data: RegressionData, rng: np.random.Generator
) -> tuple[JudgedEffect, ...]:
    """Return the refused effects of the simplest set that explains with an unphysical number.

    Only the gates of what an effect removes and of physics are asked; rivals are left out, since
    they do not matter for an effect that physics refuses.
    """
    near = [o for o in hypotheses.fitted.values() if o.effects]
    near = [
        o for o in near if hypotheses.within_form_tolerance(o) and hypotheses.physical_problem(o)
    ]
    if not near:
        return ()
    best = min(near, key=lambda o: (o.size[1], o.total))
    effects = gates.judge_effects(hypotheses, best, holdout_data, rng)
    asked = (gates.REMOVES, gates.PHYSICAL)
    judged = [replace(f, gates=tuple(g for g in f.gates if g.name in asked)) for f in effects]
    return tuple(replace(f, rivals=()) for f in judged if not gates.passes_gates(f))


def remainder_notes(
    verdict: str, left: Sequence[Remainder], in_noise: bool, named: bool
) -> list[str]:
    """State what remains in each equation, where the verdict itself does not say it.

    `in_noise`: the training records hold nothing above the noise; `named`: an effect is named.
    """
    out = []
    if verdict == UNEXPLAINED and (named or in_noise):
        out += [f"{r.equation}: {r.words}" for r in left if r.veto]
    return [*out, *(f"{r.equation}: {r.words}" for r in left if not r.veto)]


def _apply_gates(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData,
    rng: np.random.Generator,
) -> Judgement:  # fmt: skip
    """Put a set through the gates, extend it in single equations, and give the verdict.

    Refused effects are among the judged ones only if the verdict is `unexplained`.
    """
    effects, refused, winner = _passing_set(hypotheses, winner, holdout_data, rng)
    left = remainders(hypotheses, winner, holdout_data)
    all_refused = bool(refused) and not winner.effects
    if not all_refused:
        effects, winner, left = _extended_set(hypotheses, effects, winner, left, holdout_data, rng)
    if all_refused or any(r.veto for r in left):
        verdict = UNEXPLAINED
        above = {r.equation for r in left if r.veto}
        effects = judged_beside_unknown_cause(hypotheses, winner, effects, above)
        effects = (*effects, *refused)
    elif not winner.effects:  # too little remains for any effect to be needed
        verdict = CLEAN
    else:
        verdict = CONFOUNDED if has_tied_rival(effects) else EXPLAINED
    return Judgement(hypotheses, effects, winner, verdict, tuple(left))


def _passing_set(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData,
    rng: np.random.Generator,
) -> tuple[tuple[JudgedEffect, ...], tuple[JudgedEffect, ...], Hypothesis]:  # fmt: skip
    """Return the effects that pass every gate together, the refused ones, and the set of the first.

    An effect may pass beside others and fail without them, so that a reduced set is judged again.
    """
    refused: tuple[JudgedEffect, ...] = ()
    while winner.effects:
        effects = gates.judge_effects(hypotheses, winner, holdout_data, rng)
        judged = dict(zip(winner.effects, effects, strict=True))
        failed = [used for used, f in judged.items() if not gates.passes_gates(f)]
        if not failed:
            return effects, refused, winner
        dropped = _least_needed(hypotheses, winner, failed)
        refused += tuple(judged[used] for used in dropped)
        kept = [used for used in winner.effects if used not in dropped]
        winner = hypotheses.refined(kept)
    return (), refused, winner


def _least_needed(
    hypotheses: HypothesisSet, winner: Hypothesis, failed: Sequence[Used]
) -> list[Used]:
    """Return the failed effects to leave out: of those of one family at one place, one.

    Each of two frictions of a joint removes little beside the other, and one of them is needed. The
    one without which least is left goes first.
    """

    def left_without(used: Used) -> float:
        return hypotheses.refined(winner.without(used)).total

    least: dict[tuple[str, str], Used] = {}
    for used in sorted(failed, key=left_without, reverse=True):
        least[effect_in(used).family, used.term.where] = used
    return [used for used in failed if used in least.values()]


def _completes(
    hypotheses: HypothesisSet, winner: Hypothesis, larger: Hypothesis, equations: Collection[str]
) -> bool:
    """Return whether a further effect removes all but `SEARCH.further_share` of what `winner` left.

    Only in equations in which the winner's effects act: what they leave there is missing from the
    explanation, while in others it is a small effect beside it.
    """
    removed = {e: v - winner.excess_energy[e] for e, v in hypotheses.empty.excess_energy.items()}
    acting = SEARCH.acting_share * max(removed.values())
    before, after = (sum(max(0.0, h.excess_energy[e]) for e in equations) for h in (winner, larger))
    return after <= SEARCH.further_share * before and all(removed[e] >= acting for e in equations)


def _extended_set(
    hypotheses: HypothesisSet, effects: tuple[JudgedEffect, ...], winner: Hypothesis,
    left: list[Remainder], holdout_data: RegressionData, rng: np.random.Generator,
) -> tuple[tuple[JudgedEffect, ...], Hypothesis, list[Remainder]]:  # fmt: skip
    """Add effects for equations that keep too much, while all pass and fewer equations do.

    Returns the judged effects, their set, and what it leaves. Where no remainder speaks against the
    set, a further effect must not change whether the answer has a tied rival, unless it completes
    the explanation or simpler names beside it make the whole set no larger.
    """
    while left:
        equations = {r.equation for r in left}
        larger = hypotheses.extended_in(winner, equations)
        if larger is None:
            break
        judged = gates.judge_effects(hypotheses, larger, holdout_data, rng)
        less = remainders(hypotheses, larger, holdout_data)
        replaces = not winner.keys <= larger.keys and sum(larger.size) <= sum(winner.size)
        completes = _completes(hypotheses, winner, larger, equations)
        needed = replaces or completes or any(r.veto for r in left)
        if not needed and has_tied_rival(judged) != has_tied_rival(effects):
            break
        if len(less) >= len(left) or not all(map(gates.passes_gates, judged)):
            break
        effects, winner, left = judged, larger, less
    return effects, winner, left
