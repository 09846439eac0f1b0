"""Effects beside an unknown cause: which of them are named where the verdict is `unexplained`.

What the unknown cause puts into the rows can make an effect seem to act that does not.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import shapes_of
from analysis.regression.least_squares import shortest
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.gates import NO_RIVAL, REMOVES
from analysis.trace.judge.inference import all_include
from analysis.trace.judge.rivals import rivals_in_words
from analysis.trace.result import Gate, JudgedEffect
from analysis.trace.search.exact_fit import design_matrix, jacobian
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]


def judged_beside_unknown_cause(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    effects: Sequence[JudgedEffect],
    unexplained: Collection[str],
) -> tuple[JudgedEffect, ...]:
    """Return the effects of the set `winner` with the gates that hold beside an unknown cause.

    `unexplained` are the equations that keep too much. An effect is refused that removes less than
    `TRACE.least_removed_beside` of the energy in its own equations, that the other equations alone
    do not show, or whose size may be nothing. Rivals that held-out records alone do not separate
    from an effect are tied.
    """
    data = hypotheses.train_data
    rows = _rows_outside(data, unexplained)
    left_outside = _energy(data, winner, rows)

    def problem(group: Sequence[Used]) -> str:
        """Return in words why effects that act together are not named ('' if they are)."""
        without = hypotheses.refined([u for u in winner.effects if u not in group])
        own = set().union(*(_equations_of(data, winner, u) for u in group))
        removed = {e: without.excess_energy[e] - winner.excess_energy[e] for e in own}
        share = sum(removed.values()) / max(1e-30, sum(without.excess_energy[e] for e in own))
        if share < TRACE.least_removed_beside:
            return (
                f"{100 * max(0.0, share):.0f} % of the repeatable energy of "
                f"{', '.join(sorted(own))}, too little beside a cause that is not known"
            )
        outside = sum(v for e, v in removed.items() if e not in unexplained)
        gain = _energy(data, without, rows) - left_outside
        asked = outside > TRACE.least_removed * sum(removed.values())
        if asked and gain < TRACE.least_removed * outside:
            return (
                f"nothing where {', '.join(sorted(unexplained))} are left out of the fit: they "
                "bend a parameter that the other equations share"
            )
        return ""

    # Of two effects that make up for one bent parameter, each seems needed beside the other.
    together = problem(winner.effects) if len(winner.effects) > 1 else ""
    used = {u.term.key: u for u in winner.effects}

    def refused(effect: JudgedEffect) -> JudgedEffect:
        own = used[effect.name, effect.at]
        why = together or problem([own]) or _size_includes_zero(data.rig, own, effect)
        return _refused(tied_in_held_out(effect), why)

    return tuple(map(refused, effects))


def _size_includes_zero(rig: Rig, used: Used, effect: JudgedEffect) -> str:
    """Return in words that the intervals of all sizes include no effect ('' if one does not).

    A size is a coefficient, or a shape with a value at which the effect vanishes. What an unknown
    cause leaves widens the intervals.
    """
    sizes = {c.parameter: 0.0 for c in used.term.coefficients(rig)}
    sizes |= {s.parameter: s.neutral for s in shapes_of(rig, used) if s.neutral is not None}
    if effect_in(used).free or not all_include(sizes, effect.parameters):
        return ""
    names = ", ".join(name for name in sizes if name in effect.parameters)
    return f"{names} may be nothing within the interval beside a cause that is not known"


def _refused(effect: JudgedEffect, problem: str) -> JudgedEffect:
    """Return an effect that fails the gate of what it removes, unchanged without a problem."""
    if not problem:
        return effect
    gates = (Gate(REMOVES, False, problem) if g.name == REMOVES else g for g in effect.gates)
    return replace(effect, gates=tuple(gates))


def _equations_of(data: RegressionData, winner: Hypothesis, used: Used) -> set[str]:
    """Return the equations in whose rows an effect acts."""
    J = jacobian(data, winner.fit, used)[1]
    return {s.equation for s in data.segments if np.any(J[s.where])}


def _rows_outside(data: RegressionData, equations: Collection[str]) -> NDArray[np.bool_]:
    """Return a mask (M,) of the rows of other equations."""
    out = np.ones(data.base.shape[0], dtype=bool)
    for s in data.segments:
        out[s.where] = s.equation not in equations
    return out


def _energy(data: RegressionData, hypothesis: Hypothesis, rows: NDArray[np.bool_]) -> float:
    """Return the energy that a set leaves in some rows if its coefficients are fitted to these."""
    design = design_matrix(data, hypothesis.fit.terms)
    X, y = design.matrix[rows], design.rhs[rows]
    left = y - X @ shortest(X, y, TRACE.rank_limit)
    return float(left @ left)


def tied_in_held_out(effect: JudgedEffect) -> JudgedEffect:
    """Return an effect with every rival tied that held-out records alone do not separate from it.

    What a fit of training records with an unknown cause in them leaves is no evidence.
    """
    rivals = [replace(r, tied=r.tied or r.ratio < TRACE.tie_ratio) for r in effect.rivals]
    rivals.sort(key=lambda r: not r.tied)
    if not any(r.tied for r in rivals):
        return effect
    kept = [gate for gate in effect.gates if gate.name != NO_RIVAL]
    gate = Gate(NO_RIVAL, False, rivals_in_words(rivals))
    return replace(effect, rivals=tuple(rivals), gates=(*kept, gate))
