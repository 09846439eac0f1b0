"""What stays when a search has ended, told by clues: variables, a frequency, a formula."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.trace import clues, held_out
from analysis.trace.board import Board
from analysis.trace.clue_formula import Formula, formula, surest
from analysis.trace.clue_frequency import frequency_clue
from analysis.trace.lines import Lines
from analysis.trace.listed import Listed
from analysis.trace.refine import rebased
from analysis.trace.result import Dependence

LOUD = 0.1  # of all that is left: an equation with less asks for no clue


def clues_to(
    stage: Board, judge: Board, winner: Listed, split: Sequence[Lines]
) -> tuple[tuple[Dependence, ...], tuple[Formula, ...]]:
    """Return what the remaining residual moves with, most telling first, and formulas for it."""
    left, held = winner.fit.left, held_out.left(judge, winner.fit)
    now, later = rebased(stage, winner.fit), rebased(judge, winner.fit)
    loud = [e for e, v in sorted(winner.excess.items(), key=lambda kv: -kv[1]) if v > 0]
    total = sum(winner.excess[e] for e in loud)
    loud = [e for e in loud if winner.excess[e] > LOUD * total]
    moves = clues.dependence(now, left, later, held, loud)
    hum = frequency_clue(split, stage, left, judge, held)
    found = [formula(now, left, later, held, e) for e in loud]
    formulas = tuple(one for one in found if one is not None)
    first = _leading(formulas) if hum is None else [hum]
    there = {d.variable for d in first}
    return (*first, *(d for d in moves if d.variable not in there)), formulas


def _leading(formulas: Sequence[Formula]) -> list[Dependence]:
    """Return the variable of the formula that leaves least, where one leaves next to nothing."""
    best = surest(formulas)
    if best is None:
        return []
    variable, by = (*best.variables, "")[:2]
    monomial = next(name for name in best.terms if variable in name)
    words = "" if monomial == variable else monomial
    return [Dependence(variable, best.share, best.equation, by, words)]
