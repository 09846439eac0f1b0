"""Clues: variables and frequencies that an unexplained residual depends on. A clue is not a name.

For each variable v a free curve of v (hat functions over quantiles, filtered like any column,
orthogonal to the model's own columns) is fitted to the equation's residual on one set of records.
It is judged on the other set, by the share of the energy above noise that it removes there
(Friedman's partial dependence, judged on held-out records). The curve may also multiply another
variable (Hastie and Tibshirani's varying coefficients): the direction of motion, with and without
memory, the velocity, the pressure difference, the spool.

A residual may also repeat at one frequency independent of the motion: hum of a pump, of the mains,
of a control loop. Then most of the power of the training residual lies at one line although the
excitation has many. The frequency is searched around that line and judged on the held-out records,
where a sine of it, with a phase for each record, must remove most of the energy above noise.
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

# Variables that the equation's balance makes follow any missing term: they do not show the cause.
FOLLOW_BY_BALANCE = {"torque": ("pressure", ch.DRIVE), "flow": ("velocity",)}
BY_BALANCE = " by balance"  # ends the words of a clue of that kind


def clues_to(
    train_data: RegressionData,
    holdout_data: RegressionData,
    winner: Hypothesis,
    lines: Sequence[SpectralLines],
) -> tuple[tuple[Dependence, ...], tuple[Formula, ...]]:
    """Return the variables that the remaining residual follows, strongest first, and formulas.

    `lines` are the spectral lines of the training residual.
    """
    residual, held_out_residuals = winner.fit.residual, held_out_residual(holdout_data, winner.fit)
    train_rows, holdout_rows = rebased(train_data, winner.fit), rebased(holdout_data, winner.fit)
    equations = [e for e, v in sorted(winner.excess_energy.items(), key=lambda kv: -kv[1]) if v > 0]
    total = sum(winner.excess_energy[e] for e in equations)
    equations = [e for e in equations if winner.excess_energy[e] > TRACE.clue_share * total]
    sides = []
    for e in equations:
        train = equation_rows(train_rows, residual, e)
        held_out = equation_rows(holdout_rows, held_out_residuals, e)
        if train is not None and held_out is not None:
            sides.append(EquationSides(train_data.rig, e, train, held_out))
    weight = {e: v for e, v in winner.excess_energy.items() if e in equations}
    variables_found = dependences(sides, weight)
    frequency = frequency_clue(lines, train_data, residual, holdout_data, held_out_residuals)
    formulas = tuple(sparse for sparse in map(formula, sides) if sparse is not None)
    leading = _formula_clue(formulas) if frequency is None else [frequency]
    listed = {d.variable for d in leading}
    return (*leading, *(d for d in variables_found if d.variable not in listed)), formulas


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
    interval = np.clip(np.searchsorted(knots, v) - 1, 0, len(knots) - 2)
    share = np.clip((v - knots[interval]) / (knots[interval + 1] - knots[interval]), 0.0, 1.0)
    rows = np.arange(len(v))
    out[rows, interval] = 1.0 - share
    out[rows, interval + 1] = share
    return out


def dependences(sides: Sequence[EquationSides], weight: Mapping[str, float]) -> list[Dependence]:
    """Return the variables that the residual depends on, those with most evidence first.

    The evidence is the share of energy above noise that a curve removes, times the variable's
    weight (`_independence_weight`). Each variable is returned once. `weight` is the training energy
    above noise of each equation.
    """
    total = sum(weight.values()) or 1.0
    shares: dict[tuple[str, str], dict[str, float]] = {}
    for side in sides:
        for key, share in _curve_shares(side).items():
            shares.setdefault(key, {})[side.equation] = share
    sums = {k: sum(s * weight[e] / total for e, s in by.items()) for k, by in shares.items()}
    ranked: list[tuple[float, Dependence]] = []
    for (name, factor), by in shares.items():
        share = sums[name, factor]
        least = CLUES.least_share
        if name and factor:  # a product must remove more than either variable alone
            alone = max(sums.get(part, 0.0) for part in ((name, ""), ("", factor)))
            least = max(least, alone + CLUES.product_gain)
        if share < least:
            continue
        equation = max(by, key=lambda e: by[e])
        independence = 1.0 if factor else _independence_weight(name, equation, sums)
        clue = _dependence_of(name, factor, share, equation, independence)
        ranked.append((share * independence, clue))
    strongest: dict[str, Dependence] = {}
    for _, clue in sorted(ranked, key=lambda pair: -pair[0]):
        strongest.setdefault(clue.variable, clue)
    return list(strongest.values())


def _dependence_of(
    name: str, factor: str, share: float, equation: str, independence: float
) -> Dependence:  # fmt: skip
    if not factor:
        words = name + BY_BALANCE if independence == CLUES.by_balance_weight else ""
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

    Each is fitted to either side and judged on the other, and the larger share counts: a curve
    fitted to small motions does not predict large ones, but the reverse does.
    """
    train, held_out, parts, joint = sides.train, sides.held_out, sides.parts, sides.joint
    values = [variables(sides.rig, p.signals, joint) for p in parts]
    by, travel = factors(sides.equation), sides.travel
    scales = [
        {f: v[f] if f in v else factor_of(f, p.signals, joint, travel) for f in by}
        for v, p in zip(values, parts, strict=True)
    ]
    curves: dict[str, list[Array]] = {"": [np.ones((len(p.signals.t), 1)) for p in parts]}
    for name in values[0]:
        moving = [
            v[name] for v, p in zip(values, parts, strict=True)
            if joint + 1 not in p.conditioned.record.locked
        ]  # fmt: skip
        knots = _knots(np.concatenate(moving)) if moving else None
        if knots is not None:
            curves[name] = [hat_functions(v[name], knots) for v in values]
    out = {}
    for name, curve in curves.items():
        for factor in ("", *by) if name else by:
            products = curve
            if factor:
                products = [c * s[factor][:, None] for c, s in zip(curve, scales, strict=True)]
            columns, held_out_columns = sides.columns(products)
            forward = explained_share(columns, train, held_out_columns, held_out)
            backward = explained_share(held_out_columns, held_out, columns, train)
            out[name, factor] = max(0.0, forward, backward)
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
    for spectrum in sorted(lines, key=lambda spectrum: -spectrum.above_noise_after):
        peak = _peak_frequency(spectrum) if spectrum.above_noise_after >= 1.0 else None
        if peak is None:
            continue
        e, spacing = spectrum.equation, spectrum.frequency[1]
        frequencies = np.linspace(peak - spacing, peak + spacing, CLUES.frequency_steps).tolist()
        f = max(frequencies, key=functools.partial(_energy_of_sine, train, residual, e))
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
    around_peak = slice(k - CLUES.side_lines, k + CLUES.side_lines + 1)
    if power[around_peak].sum() < CLUES.peak_share * power.sum():
        return None
    return float(np.average(lines.frequency[around_peak], weights=power[around_peak]))


def _energy_of_sine(data: RegressionData, residual: Array, equation: str, f: float) -> float:
    """Return the energy above noise that a sine and a cosine of f [Hz] remove in all records."""
    total = 0.0
    for s in data.segments:
        if s.equation == equation:
            angle = 2 * np.pi * f * data.source(s)[1].time
            Q, _ = np.linalg.qr(np.column_stack((np.sin(angle), np.cos(angle))))
            total += float(np.sum((Q.T @ residual[s.where]) ** 2)) - 2.0
    return total
