"""A sparse fit of an unexplained residual by monomials: a formula as a clue, not a name.

Monomials of a joint's variables are columns like any other (filtered, whitened, orthogonal to the
model's own). They are added one by one to the set that leaves least of training and held-out
residual together, since small or large motions alone do not separate a cube from a line; those that
remove little are then dropped (forward and backward selection; sparse identification, Brunton,
Proctor and Kutz 2016). Coefficients are fitted to the training records and judged on the held-out
ones. In a torque the monomials are forces at the piston, times the linkage's G.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.signals.conditioning import Signals
from analysis.trace.clues.equation_rows import (
    EquationRows,
    EquationSides,
    explained_share,
    factor_of,
    fitted_coefficients,
)
from analysis.trace.result import Formula
from analysis.trace.settings import CLUES
from rig.model import channels as ch
from rig.model.rig import Rig

Array = NDArray[np.float64]


def surest_formula(formulas: Sequence[Formula]) -> Formula | None:
    """Return the sure formula that leaves least, None where none is sure."""
    return max((f for f in formulas if f.sure), key=lambda f: f.share, default=None)


def formula(sides: EquationSides) -> Formula | None:
    """Return a formula for an equation's residual, None where none removes `CLUES.shown_share`."""
    equation, train, held_out = sides.equation, sides.train, sides.held_out
    names, *columns = _candidate_monomials(sides)
    both = EquationRows((), np.concatenate((train.residual, held_out.residual)), np.zeros((0, 0)))
    selected = _selected_columns(np.concatenate(columns), both)
    if not selected:
        return None
    fitted, judged = (side[:, selected] for side in columns)
    share = explained_share(fitted, train, judged, held_out)
    if share < CLUES.shown_share:
        return None
    values = fitted_coefficients(fitted, train)
    terms = {names[k]: float(v) for k, v in zip(selected, values, strict=True)}
    if is_balance(equation, terms):
        return None
    at_piston = equation.startswith("torque") and not sides.rig.electric
    return Formula(equation, terms, share, at_piston)


def is_balance(equation: str, terms: Mapping[str, float]) -> bool:
    """Return whether a formula holds both chambers' pressures with opposite signs and one factor.

    That is the cylinder's force times the factor. A torque's own balance makes this force follow
    whatever the torque lacks, so that it is no sign of a cause.
    """
    kind, joint = equation.rsplit("_", 1)
    sides = [ch.channel(side, int(joint)) for side in (ch.CAP, ch.ROD)]
    cap, rod = (
        {name[len(side) :]: value for name, value in terms.items() if name.startswith(side)}
        for side in sides
    )
    return kind == "torque" and any(cap[by] * rod[by] < 0.0 for by in cap.keys() & rod.keys())


def _candidate_monomials(sides: EquationSides) -> tuple[list[str], Array, Array]:
    """Return the monomials' names and columns on either side, nearly equal ones only once."""
    rig, equation, joint, travel = sides.rig, sides.equation, sides.joint, sides.travel
    monomials = [_monomials(rig, equation, part.signals, joint, travel) for part in sides.parts]
    names = list(monomials[0])
    first, second = sides.columns([np.column_stack([m[n] for n in names]) for m in monomials])
    columns = np.concatenate((first, second))
    size = np.linalg.norm(columns, axis=0)
    distinct: list[int] = []
    most = CLUES.duplicate_correlation
    for k in np.flatnonzero(size > 1e-12):
        unit = columns[:, k] / size[k]
        if all(abs(float(unit @ columns[:, j])) < most * size[j] for j in distinct):
            distinct.append(int(k))
    return [names[k] for k in distinct], first[:, distinct], second[:, distinct]


def _monomials(
    rig: Rig, equation: str, signals: Signals, joint: int, travel: float
) -> dict[str, Array]:  # fmt: skip
    """Return the monomials (n,) by name, simpler ones first: of equal ones the first is kept."""
    i, t = joint + 1, signals.t
    place, v = ch.channel(rig.position_kind, i), f"velocity_{i}"
    s, sd = (signals.q, signals.qd) if rig.electric else (signals.s, signals.sd)
    x, w = s[:, joint], sd[:, joint]
    sign = factor_of("direction", signals, joint, travel)
    out = {
        "1": np.ones(len(t)), place: x, f"{place}²": x**2, f"{place}³": x**3,
        v: w, f"{v} |{v}|": w * np.abs(w), f"{v}²": w**2, f"{v}³": w**3,
        f"sign({v})": sign, f"{place} {v}": x * w, f"{place} sign({v})": x * sign,
        f"{place}² {v}": x**2 * w, "time": t, f"time {v}": t * w,
    }  # fmt: skip
    if rig.electric:
        return out
    cap, rod, u = signals.p_cap[:, joint], signals.p_rod[:, joint], signals.u[:, joint]
    sides = {ch.channel(ch.CAP, i): cap, ch.channel(ch.ROD, i): rod}
    for name, y in sides.items():
        out[f"{name} time"] = y * t
    if equation.startswith("torque"):
        # Pressures and their squares are the balance's other side: they would fit any residual.
        out |= {f"{name} sign({v})": y * sign for name, y in sides.items()}
        return {name: signals.G[:, joint] * y for name, y in out.items()}
    # So is the velocity in a flow's balance, and any product with it: for a boom that only comes
    # down all these products are alike.
    out = {name: y for name, y in out.items() if v not in name}
    out |= {f"{name}²": y**2 for name, y in sides.items()}
    spool = ch.channel(ch.SPOOL, i)
    out |= {spool: u, f"{spool}²": u**2, f"{spool} |{spool}|": u * np.abs(u), f"{spool}³": u**3}
    for name, y in {**sides, ch.SUPPLY: signals.p_s}.items():
        out |= {name: y, f"{name} {spool}": y * u}
    return out | {f"{place} {spool}": x * u, f"{spool} time": u * t}


def _selected_columns(columns: Array, side: EquationRows) -> list[int]:
    """Return the numbers of the columns selected, in order of selection."""
    selected: list[int] = []
    share = 0.0
    while len(selected) < min(CLUES.monomials, columns.shape[1]):
        others = [k for k in range(columns.shape[1]) if k not in selected]
        shares = {k: _joint_share([*selected, k], columns, side) for k in others}
        best = max(others, key=lambda k: shares[k])
        if shares[best] < share + CLUES.monomial_gain:
            break
        selected, share = [*selected, best], shares[best]
    for k in list(selected):
        fewer = [j for j in selected if j != k]
        if fewer and _joint_share(fewer, columns, side) > share - CLUES.monomial_gain:
            selected = fewer
    return selected


def _joint_share(chosen: list[int], columns: Array, side: EquationRows) -> float:
    """Return the share of a side's energy above noise that the chosen columns remove."""
    return explained_share(columns[:, chosen], side, columns[:, chosen], side)
