"""What remains after a search: equations that keep too much, and clues to their residual.

A clue is a variable, a frequency or a formula that the residual follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from analysis.trace.clues import dependence
from analysis.trace.clues.formula import formula, surest_formula
from analysis.trace.clues.frequency import frequency_clue
from analysis.trace.data.candidates import effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.spectral_lines import SpectralLines
from analysis.trace.judge import gates, held_out
from analysis.trace.result import Dependence, Formula
from analysis.trace.search.exact_fit import rebased
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.units import plain


class Remainder(NamedTuple):
    """An equation that keeps more than noise, and how much in `words`.

    `veto`: it speaks against the named effects, and makes the verdict `unexplained`. Without a veto
    a further effect may still act in the equation.
    """

    equation: str
    words: str
    veto: bool


def remainders(
    hypotheses: HypothesisSet, winner: Hypothesis, holdout_data: RegressionData
) -> list[Remainder]:
    """Return the equations in which a set leaves more than noise and tolerances allow.

    First those above the band (`gates.equations_above_band`), which speak against the set, then
    those whose training energy above noise exceeds `TRACE.visible_deviations` standard deviations
    of the noise's own energy and `TRACE.visible_share` of what the baseline leaves.
    """
    out = [
        Remainder(*r, True) for r in gates.equations_above_band(hypotheses, winner, holdout_data)
    ]
    listed = {r.equation for r in out}
    counts = hypotheses.train_data.row_counts
    for e, energy in winner.excess_energy.items():
        share = energy / max(hypotheses.empty.excess_energy[e], 1e-30)
        visible = energy > TRACE.visible_deviations * np.sqrt(2 * counts[e])
        if winner.effects and e not in listed and visible and share > TRACE.visible_share:
            allowed = gates.form_share(holdout_data.rig, effects_among(winner.effects), e)
            words = f"{plain(100 * share, 2)} % of the repeatable energy remains"
            out.append(Remainder(e, words + tolerance_words(share, allowed), False))
    return out


def tolerance_words(share: float, allowed: float) -> str:
    """Say why a remaining share of the energy does not speak against the named effects.

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


def clues_to(
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
    split: Sequence[SpectralLines],
) -> tuple[tuple[Dependence, ...], tuple[Formula, ...]]:
    """Return the variables that the remaining residual follows, strongest first, and formulas.

    `split` are the spectral lines of the training residual.
    """
    residual, held_residual = (
        winner.fit.residual,
        held_out.held_out_residual(holdout_data, winner.fit),
    )
    train_rows, holdout_rows = rebased(train_data, winner.fit), rebased(holdout_data, winner.fit)
    equations = [e for e, v in sorted(winner.excess_energy.items(), key=lambda kv: -kv[1]) if v > 0]
    total = sum(winner.excess_energy[e] for e in equations)
    equations = [e for e in equations if winner.excess_energy[e] > TRACE.clue_share * total]
    moves = dependence.dependences(train_rows, residual, holdout_rows, held_residual, equations)
    hum = frequency_clue(split, train_data, residual, holdout_data, held_residual)
    candidates = [formula(train_rows, residual, holdout_rows, held_residual, e) for e in equations]
    formulas = tuple(expression for expression in candidates if expression is not None)
    first = _formula_clue(formulas) if hum is None else [hum]
    listed = {d.variable for d in first}
    return (*first, *(d for d in moves if d.variable not in listed)), formulas


def _formula_clue(formulas: Sequence[Formula]) -> list[Dependence]:
    """Return the variable of the best formula as a clue, none where no formula is sure."""
    best = surest_formula(formulas)
    if best is None:
        return []
    variable, by = (*best.variables, "")[:2]
    monomial = next(name for name in best.terms if variable in name)
    words = "" if monomial == variable else monomial
    return [Dependence(variable, best.share, best.equation, by, words)]
