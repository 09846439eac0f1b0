"""Clues: variables and frequencies that an unexplained residual depends on. A clue is not a name.

For each variable v a free curve of v (hat functions over quantiles, filtered like any column,
orthogonal to the model's own columns) is fitted to the equation's residual on one set of records.
It is judged on the other set, by the share of the energy above noise that it removes there
(Friedman's partial dependence, judged on held-out records). The curve may also multiply another
variable (Hastie and Tibshirani's varying coefficients): the direction of motion, with and without
memory, the velocity, the pressure difference, the spool.

Or the residual repeats at one frequency, whatever the joint does: hum of a pump, of the mains, of a
control loop. Most of the power of the training residual lies at one line although the excitation
has many. The frequency is searched around that line and judged on the held-out records, where a
sine and a cosine of it, with a phase for each record, must remove most of the energy above noise.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.trace.clues.equation_rows import (
    EquationSides,
    equation_rows,
    explained_share,
    factor_of,
    factors,
    variables,
)
from analysis.trace.clues.formula import formula, surest_formula
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.spectral_lines import SpectralLines
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.result import Dependence, Formula
from analysis.trace.search.exact_fit import rebased
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.settings import CLUES, TRACE
from rig.model import channels as ch

Array = NDArray[np.float64]

# An equation's own balance makes these variables follow whatever the equation lacks, so that they
# are no sign of a cause.
FOLLOW_BY_BALANCE = {"torque": ("pressure", ch.DRIVE), "flow": ("velocity",)}


def clues_to(
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
    split: Sequence[SpectralLines],
) -> tuple[tuple[Dependence, ...], tuple[Formula, ...]]:
    """Return the variables that the remaining residual follows, strongest first, and formulas.

    `split` are the spectral lines of the training residual.
    """
    residual, held_residual = winner.fit.residual, held_out_residual(holdout_data, winner.fit)
    train_rows, holdout_rows = rebased(train_data, winner.fit), rebased(holdout_data, winner.fit)
    equations = [e for e, v in sorted(winner.excess_energy.items(), key=lambda kv: -kv[1]) if v > 0]
    total = sum(winner.excess_energy[e] for e in equations)
    equations = [e for e in equations if winner.excess_energy[e] > TRACE.clue_share * total]
    sides = []
    for e in equations:
        first = equation_rows(train_rows, residual, e)
        second = equation_rows(holdout_rows, held_residual, e)
        if first is not None and second is not None:
            sides.append(EquationSides(train_data.rig, e, first, second))
    weight = {e: v for e, v in winner.excess_energy.items() if e in equations}
    moves = dependences(sides, weight)
    hum = frequency_clue(split, train_data, residual, holdout_data, held_residual)
    formulas = tuple(found for found in map(formula, sides) if found is not None)
    surest = _formula_clue(formulas) if hum is None else [hum]
    listed = {d.variable for d in surest}
    return (*surest, *(d for d in moves if d.variable not in listed)), formulas


def _formula_clue(formulas: Sequence[Formula]) -> list[Dependence]:
    """Return the variable of the best formula as a clue, none where no formula is sure."""
    best = surest_formula(formulas)
    if best is None:
        return []
    variable, by = (*best.variables, "")[:2]
    monomial = next(name for name in best.terms if variable in name)
    words = "" if monomial == variable else monomial
    return [Dependence(variable, best.share, best.equation, by, words)]


def hat_functions(v: Array, knots: Array) -> Array:
    """Return the hat functions (n, k) of a piecewise linear curve with the given knots."""
    out = np.zeros((len(v), len(knots)))
    place = np.clip(np.searchsorted(knots, v) - 1, 0, len(knots) - 2)
    share = np.clip((v - knots[place]) / (knots[place + 1] - knots[place]), 0.0, 1.0)
    at = np.arange(len(v))
    out[at, place] = 1.0 - share
    out[at, place + 1] = share
    return out


def dependences(sides: Sequence[EquationSides], weight: Mapping[str, float]) -> list[Dependence]:
    """Return the variables that the residual depends on, those with most evidence first.

    The evidence is the share of energy above noise that a curve removes, times the variable's
    weight (`_independence_weight`). Each variable is returned once. `weight` is the training energy
    above noise of each equation.
    """
    total = sum(weight.values()) or 1.0
    shares: dict[tuple[str, str], dict[str, float]] = {}
    for both in sides:
        for key, share in _curve_shares(both).items():
            shares.setdefault(key, {})[both.equation] = share
    sums = {k: sum(s * weight[e] / total for e, s in by.items()) for k, by in shares.items()}
    out: list[tuple[float, Dependence]] = []
    for (name, factor), by in shares.items():
        share = sums[name, factor]
        parts = [sums.get(part, 0.0) for part in ((name, ""), ("", factor))]
        product = name and factor
        if share < CLUES.least_share or (product and share < max(parts) + CLUES.product_gain):
            continue
        equation = max(by, key=lambda e: by[e])
        independence = 1.0 if factor else _independence_weight(name, equation, sums)
        out.append(
            (share * independence, _dependence_of(name, factor, share, equation, independence))
        )
    best: dict[str, Dependence] = {}
    for _, clue in sorted(out, key=lambda pair: -pair[0]):
        best.setdefault(clue.variable, clue)
    return list(best.values())


def _dependence_of(
    name: str, factor: str, share: float, equation: str, independence: float
) -> Dependence:  # fmt: skip
    if not factor:
        words = f"{name} by balance" if independence == CLUES.by_balance_weight else ""
        return Dependence(name, share, equation, words=words)
    by = factors(equation)[factor]
    if not name:
        return Dependence(by.variable, share, equation, words=by.words)
    return Dependence(name, share, equation, by.variable, f"{name} times {by.words}")


def _independence_weight(
    name: str, equation: str, shares: Mapping[tuple[str, str], float]
) -> float:
    """Return a variable's weight, small if the equation's own balance makes it follow the residual.

    A torque's balance makes the pressure difference follow. One chamber's pressure that removes
    `CLUES.chamber_lead` more than the difference does not follow: its sensor may be wrong.
    """
    kind, number = equation.rsplit("_", 1)
    if kind == "torque" and name in (
        ch.channel(ch.CAP, int(number)),
        ch.channel(ch.ROD, int(number)),
    ):
        difference = shares.get((f"pressure_difference_{number}", ""), 0.0)
        if shares[name, ""] > difference + CLUES.chamber_lead:
            return 1.0
    kind = kind.split("_", 1)[0]
    if any(word in name for word in FOLLOW_BY_BALANCE[kind]):
        return CLUES.by_balance_weight
    return CLUES.spool_weight if kind == "torque" and name.startswith(ch.SPOOL) else 1.0


def _curve_shares(sides: EquationSides) -> dict[tuple[str, str], float]:
    """Return the explained share of every curve, factor (variable '') and product of both.

    Each is fitted on one side and judged on the other, both ways round, and the larger share is
    used: a curve fitted to small motions does not predict large ones, but the reverse does.
    """
    first, second, every, joint = sides.first, sides.second, sides.parts, sides.joint
    values = [variables(sides.rig, p.signals, joint) for p in every]
    by = factors(sides.equation)
    scales = [
        {f: v[f] if f in v else factor_of(f, p.signals, joint, sides.travel) for f in by}
        for v, p in zip(values, every, strict=True)
    ]
    curves: dict[str, list[Array]] = {"": [np.ones((len(p.signals.t), 1)) for p in every]}
    for name in values[0]:
        moving = [
            v[name] for v, p in zip(values, every, strict=True)
            if joint + 1 not in p.conditioned.record.locked
        ]  # fmt: skip
        knots = _knots(np.concatenate(moving)) if moving else None
        if knots is not None:
            curves[name] = [hat_functions(v[name], knots) for v in values]
    out = {}
    for name, curve in curves.items():
        for factor in ("", *by) if name else by:
            made = (
                [c * s[factor][:, None] for c, s in zip(curve, scales, strict=True)]
                if factor
                else curve
            )
            one, two = sides.columns(made)
            out[name, factor] = max(
                0.0,
                explained_share(one, first, two, second),
                explained_share(two, second, one, first),
            )
    return out


def _knots(values: Array) -> Array | None:
    knots = np.unique(np.quantile(values, np.linspace(0.005, 0.995, CLUES.knots)))
    if len(knots) < 3 or np.ptp(knots) <= 1e-9 * max(1e-300, float(np.max(np.abs(knots)))):
        return None
    return np.asarray(knots)


FREQUENCY = "frequency"


def frequency_clue(
    lines: Sequence[SpectralLines],
    train: RegressionData,
    residual: Array,
    holdout_data: RegressionData,
    holdout_residual: Array,
) -> Dependence | None:
    """Return the clue of the equation with the largest residual at one frequency, None if none.

    `residual` (M,) and `holdout_residual` are the whitened residuals of the averaged training and
    held-out records.
    """
    for own in sorted(lines, key=lambda own: -own.above_noise_after):
        near = _peak_frequency(own) if own.above_noise_after >= 1.0 else None
        if near is None:
            continue
        e, width = own.equation, own.frequency[1]
        tried = np.linspace(near - width, near + width, CLUES.frequency_steps).tolist()
        f = max(tried, key=functools.partial(_energy_of_sine, train, residual, e))
        energy = energy_above_noise(holdout_data, holdout_residual)[e]
        share = _energy_of_sine(holdout_data, holdout_residual, e, f) / max(energy, 1e-300)
        if energy > 0 and share >= CLUES.frequency_share:
            return Dependence(FREQUENCY, min(1.0, share), e, words=f"a frequency of {f:.3g} Hz")
    return None


def _peak_frequency(lines: SpectralLines) -> float | None:
    """Return the frequency [Hz] of most of the remaining power, None where it is spread."""
    power = np.maximum(lines.after, 0.0)
    power[0] = 0.0
    if int(lines.excited.sum()) < CLUES.least_lines or not power.any():
        return None
    k = int(np.argmax(power))
    if k < CLUES.first_line:
        return None
    here = slice(k - CLUES.side_lines, k + CLUES.side_lines + 1)
    if power[here].sum() < CLUES.peak_share * power.sum():
        return None
    return float(np.average(lines.frequency[here], weights=power[here]))


def _energy_of_sine(data: RegressionData, residual: Array, equation: str, f: float) -> float:
    """Return the energy above noise that a sine and a cosine of f [Hz] remove in all records."""
    total = 0.0
    for s in data.segments:
        if s.equation == equation:
            angle = 2 * np.pi * f * data.source(s)[1].time
            Q, _ = np.linalg.qr(np.column_stack((np.sin(angle), np.cos(angle))))
            total += float(np.sum((Q.T @ residual[s.where]) ** 2)) - 2.0
    return total
