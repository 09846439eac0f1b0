"""Judging the sets that a search finds: gates, further effects, other names, free forms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.finding import Finding, Remainder, has_tied_rival, remainder_notes, remainders
from analysis.trace.free_forms import explained_by_free_form
from analysis.trace.judge import gates, readings
from analysis.trace.judge.gates import judged_beside_unknown_cause, with_rivals
from analysis.trace.judge.rivals import best_tied_set, cost, replaced_as_rivals
from analysis.trace.judge.unrepeated import unrepeated_floors
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, UNEXPLAINED, JudgedEffect
from analysis.trace.search.exact_trials import improved_by_exact_trials
from analysis.trace.search.exchanges import exchanged
from analysis.trace.search.extensions import extended_in, with_parts_beside
from analysis.trace.search.forward_search import search
from analysis.trace.search.hypothesis import Hypothesis, Key, effect_of
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH
from analysis.workers.pool import Pool, Serial

ONLY_HELD_OUT_MISSED = (
    "the training records are met to within the noise, the held-out ones are not: train on "
    "records with as much excitation as the held-out ones; if these have it, the machine has "
    "changed between the runs: train on records taken after the change to trace it"
)


@dataclass(frozen=True)
class Candidates:
    """What is searched: `named` effects, and `free` mechanisms tried where none of them explains.

    `sets` of named effects, where given, are compared in place of a search. `seed` draws the sign
    flips; `pool` computes the fits.
    """

    named: Sequence[Effect]
    free: Sequence[Effect]
    seed: int
    pool: Pool = field(default_factory=Serial)
    sets: Sequence[Sequence[Used]] = ()


def search_and_judge(
    rows: TraceRows, candidates: Candidates, progress: Callable[[float], None]
) -> Finding:
    """Search the candidates for the effects that the model lacks; judge them on the choosing rows.

    `progress` is called as by `HypothesisSet`.
    """
    choosing = rows.choosing
    hypotheses = HypothesisSet(rows.train, candidates.named, progress, candidates.pool)
    in_noise = hypotheses.within_noise(hypotheses.empty)
    if in_noise and not gates.equations_above_band(hypotheses, hypotheses.empty, choosing):
        return Finding(rows, hypotheses, hypotheses.empty, CLEAN)
    if candidates.sets:
        hypotheses.compute_columns()
        winner = hypotheses.best([*map(hypotheses.refined, candidates.sets)])
    else:
        found = exchanged(hypotheses, search(hypotheses))
        winner = improved_by_exact_trials(hypotheses, found)
    if in_noise:
        winner = _shown_by_held_out_rows(hypotheses, winner, choosing)
    rng = np.random.default_rng(candidates.seed)
    finding = Judge(rows, hypotheses, candidates.free, rng).best_finding(winner)
    named = any(map(gates.passes_gates, finding.effects))
    notes = remainder_notes(finding.verdict, finding.remainders, in_noise, named)
    if not in_noise or finding.verdict != UNEXPLAINED:
        return replace(finding, notes=notes)
    notes = (*_held_out_only_notes(rows.train, finding.remainders), *notes)
    if finding.winner.effects:
        return replace(finding, notes=notes)
    return replace(finding, effects=(), notes=notes)  # refused: fitted to noise


def _shown_by_held_out_rows(
    hypotheses: HypothesisSet, winner: Hypothesis, choosing: RegressionData
) -> Hypothesis:
    """Return the best fitted set with which the choosing rows are within the band, or `winner`.

    The training rows are within it without effects, but the set must remove from them the price of
    its effects and free numbers.
    """
    before = hypotheses.empty.fit.energy
    possible = [
        o for o in hypotheses.fitted.values()
        if before - o.fit.energy > SEARCH.number_price * sum(o.size)
        and not hypotheses.physical_problem(o)
        and not gates.equations_above_band(hypotheses, o, choosing)
    ]  # fmt: skip
    data = hypotheses.train_data
    return min(possible, key=lambda o: cost(data, o, choosing), default=winner)


def with_free_form(finding: Finding, candidates: Candidates) -> Finding:
    """Return the finding, or an explanation by a free form where one is needed and explains."""
    rng = np.random.default_rng(candidates.seed)
    explanation = explained_by_free_form(finding, candidates.free, rng)
    if explanation is None:
        return finding
    notes = remainder_notes(explanation.verdict, explanation.remainders, False, True)
    return replace(explanation, notes=notes)


def _held_out_only_notes(train_data: RegressionData, remaining: Sequence[Remainder]) -> list[str]:
    """State why only held-out records are above the band: no repetition, or little excitation."""
    above_band = sorted({r.equation for r in remaining if r.veto})
    unrepeated = [e for e in above_band if e in unrepeated_floors(train_data)]
    out = [
        f"{e}: the training repeats differ from each other too: the cause changes with time or "
        "does not follow the excitation, and more excitation would not show it"
        for e in unrepeated
    ]
    return out if unrepeated == above_band else [*out, ONLY_HELD_OUT_MISSED]


@dataclass(frozen=True)
class Judge:
    """Judges fitted sets of effects by the choosing rows.

    `free` are mechanisms without a named form; `rng` draws the sign flips.
    """

    rows: TraceRows
    hypotheses: HypothesisSet
    free: Sequence[Effect]
    rng: np.random.Generator

    @property
    def choosing(self) -> RegressionData:
        """The rows that choose between effects."""
        return self.rows.choosing

    def best_finding(self, winner: Hypothesis) -> Finding:
        """Judge the set of the search by its simplest readings; try free forms if it fails.

        Where the simplest readings do not explain, others of their laws are judged first
        (`_under_other_names`).
        """
        simplest = readings.best_readings(self.hypotheses, winner, self.choosing)
        finding = self.apply_gates(simplest)
        if finding.verdict == UNEXPLAINED:
            finding = self._under_other_names(winner, simplest) or finding
        if finding.verdict == CONFOUNDED:
            finding = self._usual_cause(self._best_tied_set(finding))
        by_free_form = explained_by_free_form(finding, self.free, self.rng)
        if by_free_form is None and finding.verdict == UNEXPLAINED:
            return replace(finding, effects=(*finding.effects, *self._refused_as_unphysical()))
        return by_free_form or finding

    def _under_other_names(self, winner: Hypothesis, simplest: Hypothesis) -> Finding | None:
        """Return an explanation by other names of the laws of a set, None if there is none.

        They are those that the search found, then both parts of a law, of which one was judged: a
        level alone, or a breakaway alone, has not the same size at all speeds where both act.
        """
        parts = map(self.hypotheses.refined, with_parts_beside(self.hypotheses, simplest))
        for other in (winner, *sorted(parts, key=lambda o: o.total)):
            if other.keys != simplest.keys:
                finding = self.apply_gates(other)
                if finding.verdict != UNEXPLAINED:
                    return finding
        return None

    def _best_tied_set(self, finding: Finding) -> Finding:
        """Return the finding with the best of the sets that the records cannot separate."""
        best = best_tied_set(self.hypotheses, finding.winner, finding.effects, self.choosing)
        if best is finding.winner:
            return finding
        other = self.apply_gates(best)
        all_pass = best.keys <= other.winner.keys
        return other if all_pass and other.verdict == CONFOUNDED else finding

    def _usual_cause(self, finding: Finding) -> Finding:
        """Return the finding with the usual cause of the same records named in place of effects.

        It takes their place if it passes the gates and fits as well. They remain its rivals.
        """
        for keys, replaced in self._usual_causes(finding.winner).items():
            others = [used for used in finding.winner.effects if used not in replaced]
            usual = (at_start(self.rows.train.rig, effect_of(*key)) for key in keys)
            cause = self.hypotheses.refined([*others, *usual])
            rivals = replaced_as_rivals(self.hypotheses, finding.winner, cause, self.choosing)
            judged = self.apply_gates(cause) if rivals else finding
            if judged.verdict != UNEXPLAINED and set(keys) <= judged.winner.keys:
                effects = tuple(
                    with_rivals(f, [*rivals, *f.rivals]) if (f.name, f.at) in keys else f
                    for f in judged.effects
                )
                return replace(judged, effects=effects, verdict=CONFOUNDED)
        return finding

    def _usual_causes(self, winner: Hypothesis) -> dict[tuple[Key, ...], list[Used]]:
        """Return the effects of a set that have a usual cause in their place, by that cause."""
        causes: dict[tuple[Key, ...], list[Used]] = {}
        for used in winner.effects:
            beside = winner.without(used)
            keys = effect_in(used).usual_beside(self.rows.train.rig, used.shape, beside)
            if keys and not winner.keys & set(keys):
                causes.setdefault(keys, []).append(used)
        return causes

    def _refused_as_unphysical(self) -> tuple[JudgedEffect, ...]:
        """Return the refused effects of the simplest set that explains with an unphysical number.

        Only the gates of removed energy and of physics count; rivals do not matter for an effect
        that is refused as unphysical.
        """
        explaining = [
            o for o in self.hypotheses.fitted.values()
            if o.effects and self.hypotheses.within_form_tolerance(o)
            and self.hypotheses.physical_problem(o)
        ]  # fmt: skip
        if not explaining:
            return ()
        best = min(explaining, key=lambda o: (o.size[1], o.total))
        effects = gates.judge_effects(self.hypotheses, best, self.choosing, self.rng)
        tested = (gates.REMOVES, gates.PHYSICAL)
        judged = [
            replace(f, rivals=(), gates=tuple(g for g in f.gates if g.name in tested))
            for f in effects
        ]
        return tuple(f for f in judged if not gates.passes_gates(f))

    def apply_gates(self, winner: Hypothesis) -> Finding:
        """Put a set through the gates, extend it in single equations, and give the verdict.

        Refused effects are among the judged ones only if the verdict is `unexplained`.
        """
        effects, refused, winner = self._passing_set(winner)
        remaining = remainders(self.hypotheses, winner, self.choosing)
        finding = Finding(self.rows, self.hypotheses, winner, CLEAN, effects, remaining)
        all_refused = bool(refused) and not winner.effects
        if not all_refused:
            finding = self._extended(finding)
        above = {r.equation for r in finding.remainders if r.veto}
        if all_refused or above:
            winner, effects = finding.winner, finding.effects
            effects = judged_beside_unknown_cause(self.hypotheses, winner, effects, above)
            return replace(finding, verdict=UNEXPLAINED, effects=(*effects, *refused))
        if not finding.winner.effects:  # too little remains for any effect to be needed
            return finding
        verdict = CONFOUNDED if has_tied_rival(finding.effects) else EXPLAINED
        return replace(finding, verdict=verdict)

    def _passing_set(
        self, winner: Hypothesis
    ) -> tuple[tuple[JudgedEffect, ...], tuple[JudgedEffect, ...], Hypothesis]:
        """Return the effects that pass every gate together, the refused ones, the set of the first.

        An effect may pass beside others and fail without them, or fail since another one of the set
        is unphysical: that one is left out first, and a reduced set is judged again.
        """
        refused: tuple[JudgedEffect, ...] = ()
        while winner.effects:
            effects = gates.judge_effects(self.hypotheses, winner, self.choosing, self.rng)
            judged = dict(zip(winner.effects, effects, strict=True))
            failed = [used for used, f in judged.items() if not gates.passes_gates(f)]
            if not failed:
                return effects, refused, winner
            dropped = self._least_needed(winner, self._unphysical_of(winner, failed) or failed)
            refused += tuple(judged[used] for used in dropped)
            winner = self.hypotheses.refined([u for u in winner.effects if u not in dropped])
        return (), refused, winner

    def _unphysical_of(self, winner: Hypothesis, failed: Sequence[Used]) -> list[Used]:
        """Return the failed effects that are themselves unphysical; the others may be right."""
        return [used for used in failed if self.hypotheses.effect_problem(winner, used)]

    def _least_needed(self, winner: Hypothesis, failed: Sequence[Used]) -> list[Used]:
        """Return the failed effects to leave out: of those of one family at one place, one.

        Each of two frictions of a joint removes little beside the other, and one of them is needed.
        The one whose removal leaves least energy is left out.
        """

        def energy_without(used: Used) -> float:
            return self.hypotheses.refined(winner.without(used)).total

        needed: dict[tuple[str, str], Used] = {}
        for used in sorted(failed, key=energy_without, reverse=True):
            needed[effect_in(used).family, used.term.where] = used
        return [used for used in failed if used in needed.values()]

    def _extended(self, finding: Finding) -> Finding:
        """Add effects for the remainders, while all pass the gates and the remainders get fewer.

        Where no remainder has a veto, a further effect must not change whether the answer has a
        tied rival, unless it completes the explanation or the set gets no larger.
        """
        while finding.remainders:
            winner, remaining = finding.winner, finding.remainders
            equations = {r.equation for r in remaining}
            larger = extended_in(self.hypotheses, winner, equations)
            if larger is None:
                break
            judged = gates.judge_effects(self.hypotheses, larger, self.choosing, self.rng)
            remaining_after = remainders(self.hypotheses, larger, self.choosing)
            replaces = not winner.keys <= larger.keys and sum(larger.size) <= sum(winner.size)
            completes = self._completes(winner, larger, equations)
            needed = replaces or completes or any(r.veto for r in remaining)
            if not needed and has_tied_rival(judged) != has_tied_rival(finding.effects):
                break
            if len(remaining_after) >= len(remaining) or not all(map(gates.passes_gates, judged)):
                break
            finding = replace(finding, effects=judged, winner=larger, remainders=remaining_after)
        return finding

    def _completes(
        self, winner: Hypothesis, larger: Hypothesis, equations: Collection[str]
    ) -> bool:
        """Return whether an effect removes all but `SEARCH.further_share` of what `winner` left.

        That holds only in equations in which the winner's effects act: a residual there completes
        the explanation, while one in other equations is a small effect beside it.
        """
        start = self.hypotheses.empty.excess_energy
        removed = {e: v - winner.excess_energy[e] for e, v in start.items()}
        acting = SEARCH.acting_share * max(removed.values())
        before, after = (
            sum(max(0.0, h.excess_energy[e]) for e in equations) for h in (winner, larger)
        )
        within = all(removed[e] >= acting for e in equations)
        return after <= SEARCH.further_share * before and within
