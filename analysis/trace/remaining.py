"""What stays when a search has ended: whether it is nothing, and what tells it.

Clues tell it: variables, a frequency, a formula.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.trace.clues import dependence
from analysis.trace.clues.formula import Formula, formula, surest
from analysis.trace.clues.frequency import frequency_clue
from analysis.trace.data.regression_data import Board
from analysis.trace.data.spectral_lines import Lines
from analysis.trace.judge import gates, held_out
from analysis.trace.result import Dependence
from analysis.trace.search.hypothesis import Listed
from analysis.trace.search.hypothesis_set import Shortlist
from analysis.trace.search.refinement import rebased

LOUD = 0.1  # of all that is left: an equation with less asks for no clue
# What the band lets pass is looked at again from here on: deviations of the noise's own energy,
# and share of what was there before. A catalogue's simpler form leaves what no formula holds.
SEEN = 8.0
SHARE = 0.005
HELD = 0.7  # share of the rest from which a formula holds it


def left_over(listed: Shortlist, winner: Listed, judge: Board) -> list[tuple[str, str]]:
    """Return the equations that keep more than is nothing, and say what.

    Beside those that keep more than the noise floor's band (`gates.remaining`), those whose rest
    one formula holds: it is no noise, and no form that is only a little simpler.
    """
    out = gates.remaining(listed, winner, judge)
    seen = _seen(listed, winner) if winner.effects else {}
    known = {equation for equation, _ in out}
    asked = [equation for equation in seen if equation not in known]
    if not asked:
        return out
    now, later = rebased(listed.stage, winner.fit), rebased(judge, winner.fit)
    held = held_out.left(judge, winner.fit)
    for equation in asked:
        found = formula(now, winner.fit.left, later, held, equation)
        if found is not None and found.share >= HELD:
            words = f"{100 * seen[equation]:.2g} % of what repeated stays, and a formula holds it"
            out.append((equation, f"{words}: {found.text}"))
    return out


def _seen(listed: Shortlist, winner: Listed) -> dict[str, float]:
    """Return the share that stays, by equation, where it stands out of the noise's own energy."""
    rows: dict[str, int] = {}
    for s in listed.stage.segments:
        rows[s.equation] = rows.get(s.equation, 0) + s.where.stop - s.where.start
    shares = {e: v / max(listed.empty.excess[e], 1e-30) for e, v in winner.excess.items()}
    return {
        e: share
        for e, share in shares.items()
        if share > SHARE and winner.excess[e] > SEEN * np.sqrt(2 * rows[e])
    }


def clues_to(
    stage: Board, judge: Board, winner: Listed, split: Sequence[Lines]
) -> tuple[tuple[Dependence, ...], tuple[Formula, ...]]:
    """Return what the remaining residual moves with, most telling first, and formulas for it."""
    left, held = winner.fit.left, held_out.left(judge, winner.fit)
    now, later = rebased(stage, winner.fit), rebased(judge, winner.fit)
    loud = [e for e, v in sorted(winner.excess.items(), key=lambda kv: -kv[1]) if v > 0]
    total = sum(winner.excess[e] for e in loud)
    loud = [e for e in loud if winner.excess[e] > LOUD * total]
    moves = dependence.dependence(now, left, later, held, loud)
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
