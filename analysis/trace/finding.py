"""The finding on given rows: judged effects, the set of those that passed, verdict, remainders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from analysis.trace.data.candidates import effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.judge import gates
from analysis.trace.result import UNEXPLAINED, Gate, JudgedEffect
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.units import plain


class Remainder(NamedTuple):
    """An equation that keeps more than noise, with the amount in `words`.

    `veto`: it refutes the named effects and makes the verdict `unexplained`. Without a veto a
    further effect may still act in the equation.
    """

    equation: str
    words: str
    veto: bool


def remainders(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> tuple[Remainder, ...]:
    """Return the equations in which a set leaves more than noise and tolerances allow.

    First those above the band (`gates.equations_above_band`), which refute the set, then those
    whose training energy above noise exceeds `TRACE.visible_deviations` standard deviations of the
    noise's own energy and `TRACE.visible_share` of what the baseline leaves.
    """
    out = [
        Remainder(*r, True) for r in gates.equations_above_band(hypotheses, winner, holdout_data)
    ]
    listed = {r.equation for r in out}
    counts = hypotheses.train_data.row_counts
    for e, energy in winner.excess_energy.items():
        before = hypotheses.empty.excess_energy[e]
        share = energy / max(before, 1e-30)
        visible = energy > TRACE.visible_deviations * np.sqrt(2 * counts[e])
        if winner.effects and e not in listed and visible and share > TRACE.visible_share:
            form_share = gates.form_share(holdout_data.rig, effects_among(winner.effects), e)
            words = f"{plain(100 * share, 2)} % of the repeatable energy remains"
            words += tolerance_words(share, form_share)
            if energy > before:
                times = plain(float(np.sqrt(1.0 + energy / counts[e])), 3)
                words = (
                    f"the repeatable rms is {times} times the noise, more than under the baseline"
                )
            out.append(Remainder(e, words, False))
    return tuple(out)


def tolerance_words(share: float, allowed: float) -> str:
    """Return in words why a remaining share of the energy does not refute the named effects.

    `allowed` is the share that their forms may miss (`gates.form_share`).
    """
    if share <= allowed:
        return "; within the tolerance for the form of the named effect"
    if share < 1.0 - TRACE.least_removed:
        missed = "the form of a named effect may miss" if allowed else "noise"
        return f"; more than {missed}, unlike in held-out records"
    return (
        "; no named effect acts there, and the residual is too close to the noise to name another"
    )


@dataclass(frozen=True)
class Finding:
    """The answer on some rows.

    `effects` are all effects that were judged, refused ones included; `winner` is the set of those
    that passed; `remainders` are the equations in which it leaves too much; `hypotheses` are all
    sets that were fitted.
    """

    rows: TraceRows
    hypotheses: HypothesisSet
    winner: Hypothesis
    verdict: str
    effects: tuple[JudgedEffect, ...] = ()
    remainders: tuple[Remainder, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def trained_on_noise(self) -> bool:
        """Whether the training rows hold no more than noise without any effect."""
        return self.hypotheses.within_noise(self.hypotheses.empty)

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


def has_tied_rival(effects: tuple[JudgedEffect, ...]) -> bool:
    """Return whether the records cannot separate one of the effects from a rival."""
    return any(rival.tied for effect in effects for rival in effect.rivals)


def remainder_notes(
    verdict: str, remaining: Sequence[Remainder], in_noise: bool, named: bool
) -> tuple[str, ...]:
    """State what remains in each equation, where the verdict itself does not say it.

    `in_noise`: the training records hold nothing above the noise; `named`: an effect is named.
    """
    out = []
    if verdict == UNEXPLAINED and (named or in_noise):
        out += [f"{r.equation}: {r.words}" for r in remaining if r.veto]
    return (*out, *(f"{r.equation}: {r.words}" for r in remaining if not r.veto))


def without_unnamed_effects(finding: Finding) -> Finding:
    """Return a finding whose set (`winner`) holds only the effects that are named."""
    named = {(f.name, f.at) for f in finding.named}
    hypotheses, winner = finding.hypotheses, finding.winner
    named_effects = [u for u in winner.effects if u.term.key in named]
    if len(named_effects) == len(winner.effects):
        return finding
    winner = hypotheses.refined(named_effects)
    remaining = remainders(hypotheses, winner, finding.rows.choosing) if named_effects else ()
    notes = remainder_notes(finding.verdict, remaining, in_noise=False, named=bool(named_effects))
    return replace(finding, winner=winner, remainders=remaining, notes=notes)


def remaining_fraction(
    hypotheses: HypothesisSet, winner: Hypothesis, as_recorded: RegressionData
) -> float:
    """Return the share of the training energy above noise under the baseline that remains.

    `as_recorded` are the training rows before any sine was taken out of them.
    """
    noise = {(f.group, f.equation): f.noise for f in as_recorded.floors}
    sine_energy = sum(
        s.count * max(0.0, (noise[s.group, s.equation] / s.noise) ** 2 - 1)
        for s in hypotheses.train_data.segments
    )
    start = hypotheses.empty.total + sine_energy
    return float(min(1.0, winner.total / start)) if start > 0 else 0.0
