"""Residuals of the regression per step and equation: systematic part, and scatter of repeats.

Repeats of a step had the same excitation, started at the same sample. With n repeats r_k(t),
 scatter^2 = mean_t var_k(r_k)  (ddof 1),   repeatable^2 = mean_t(mean_k r)^2 - scatter^2 / n,
so that noise averaged over n repeats is not counted as model error (negative estimates are zero).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from analysis.identify.result import Identification
from analysis.identify.stacked_rows import RecordRows
from analysis.regression.least_squares import least_squares
from analysis.regression.nonlinear import linearised, reduced
from analysis.regression.rows import Array, Rows, parameters_of
from analysis.regression.solve import RowCluster, solve, triangle
from analysis.report.settings import REPORT
from analysis.simulation.model import Model
from analysis.terms.base import family_of, inverted

KINDS = ("torque", "flow_cap", "flow_rod")


@dataclass(frozen=True)
class Residual:
    """One equation of one step: rows in time and figures, SI (N m or m^3/s).

    `mean` (m,) is the residual averaged over repeats, `scatter_band` (m,) its standard deviation
    between repeats (NaN for one repeat), `side` (m,) the right-hand side averaged alike.
    Spectra are amplitude densities [unit/sqrt(Hz)] over `frequency` [Hz].
    """

    run: int
    step: str
    equation: str
    joint: int
    unit: str
    repeats: int
    rows: int
    masked: int
    time: Array
    side: Array
    mean: Array
    scatter_band: Array
    rms_side: float
    rms: float
    repeatable: float
    scatter: float
    frequency: Array
    spectrum: Array
    spectrum_scatter: Array


def coefficients(
    identification: Identification, per_record: Sequence[RecordRows]
) -> dict[str, Array]:
    """Return the rows' coefficients (k,) by family, finite for unidentified parameters as well.

    Where fewer parameters determine them (`Term.reduction`), they are computed from these. Where
    only a combination is determined, the shortest coefficients that fit the rows are used: the
    residual does not depend on the choice.
    """
    rig, terms = identification.model.rig, identification.model.terms
    out = {}
    for family, solution in identification.solutions.items():
        values = dict(zip(solution.names, solution.value, strict=True))
        beta = linearised(rig, terms, parameters_of(rig, terms, family), values).at(solution.value)
        if not np.isfinite(beta).all():
            parts = [rows for record in per_record for rows in record.family(family)]
            X, y = np.vstack([r.matrix for r in parts]), np.concatenate([r.rhs for r in parts])
            beta = least_squares(X, y)
        out[family] = beta
    return out


def residuals(identification: Identification, per_record: Sequence[RecordRows]) -> list[Residual]:
    """Return the residual of every equation of every (run, step), torque before flows."""
    beta = coefficients(identification, per_record)
    groups: dict[tuple[int, str], list[RecordRows]] = {}
    for record in per_record:
        groups.setdefault(record.group, []).append(record)
    out = []
    for (run, step), members in groups.items():
        names = sorted(members[0].rows, key=_order)
        for name in names:
            rows = [m.rows[name] for m in members if name in m.rows]
            residual = _residual(run, step, name, rows, beta[family_of(name)])
            if residual is not None:
                out.append(residual)
    return out


def _order(equation: str) -> tuple[int, int]:
    kind, joint = equation.rsplit("_", 1)
    return int(joint), KINDS.index(kind)


def _residual(run: int, step: str, name: str, rows: Sequence[Rows], beta: Array) -> Residual | None:
    common = rows[0].time
    for r in rows[1:]:
        common = np.intersect1d(common, r.time)
    if len(common) < 2:
        return None
    masks = [np.isin(r.time, common) for r in rows]
    side = np.array([r.rhs[p] for r, p in zip(rows, masks, strict=True)])
    by_repeat = np.array([(r.rhs - r.matrix @ beta)[p] for r, p in zip(rows, masks, strict=True)])
    n = len(rows)
    band = by_repeat.std(axis=0, ddof=1) if n > 1 else np.full(len(common), np.nan)
    scatter = float(np.sqrt(np.mean(band**2)))
    mean = by_repeat.mean(axis=0)
    systematic = float(np.mean(mean**2)) - (scatter**2 / n if n > 1 else 0.0)
    frequency, spectrum = _density(common, mean)
    noise = (
        np.sqrt(np.mean([_density(common, r - mean)[1] ** 2 for r in by_repeat], axis=0)
                * n / (n - 1))
        if n > 1 else np.full(len(frequency), np.nan)
    )  # fmt: skip
    kind, joint = name.rsplit("_", 1)
    return Residual(
        run, step, name, int(joint), "N*m" if kind == "torque" else "m^3/s", n,
        sum(len(r.rhs) for r in rows), sum(r.masked for r in rows), common, side.mean(axis=0),
        mean, band, _rms(side), _rms(by_repeat), float(np.sqrt(max(systematic, 0.0))), scatter,
        frequency, spectrum, noise,
    )  # fmt: skip


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _density(t: Array, x: Array) -> tuple[Array, Array]:
    """Return frequency [Hz] above zero and amplitude density [unit/sqrt(Hz)] by Welch's method.

    Rows that were masked leave gaps: they are filled with zeros, and the power is divided by the
    share of rows present, which is right on average for a stationary residual.
    """
    step = float(np.median(np.diff(t)))
    index = np.rint((t - t[0]) / step).astype(int)
    filled = np.zeros(int(index[-1]) + 1)
    filled[index] = x
    share = len(x) / len(filled)
    length = min(len(filled), max(8, round(REPORT.spectrum_seconds / step)))
    frequency, power = welch(filled, 1.0 / step, nperseg=length, detrend=False)
    return np.asarray(frequency[1:]), np.asarray(np.sqrt(power[1:] / share))


@dataclass(frozen=True)
class Scatter:
    """A parameter identified from each repeat: lowest, mean, highest, RSD [%], number."""

    low: float
    mean: float
    high: float
    rsd: float
    repeats: int


def per_repeat(
    identification: Identification, per_record: Sequence[RecordRows]
) -> dict[str, Scatter]:
    """Identify from each repeat separately (paper, Table III); {} with fewer than two repeats."""
    by_repeat: dict[int, list[RecordRows]] = {}
    for record in per_record:
        by_repeat.setdefault(record.record.repeat, []).append(record)
    steps = {record.group for record in per_record}
    complete = [m for m in by_repeat.values() if {record.group for record in m} == steps]
    if len(complete) < 2:
        return {}
    model = identification.model
    by_equation: dict[str, list[float]] = {}
    for members in complete:
        for family in identification.solutions:
            alone = _solve_repeat(model, members, family)
            for name, value in inverted(model.rig, model.terms, alone).items():
                by_equation.setdefault(name, []).append(value)
    return {name: _scatter(np.array(values)) for name, values in by_equation.items()}


def _solve_repeat(model: Model, members: Sequence[RecordRows], family: str) -> Mapping[str, float]:
    clusters = []
    for member in members:
        rows = member.family(family)
        if rows:
            matrix = np.concatenate([r.matrix for r in rows])
            rhs = np.concatenate([r.rhs for r in rows])
            clusters.append(
                RowCluster(member.group, member.record.repeat, triangle(matrix, rhs), len(rhs))
            )
    if not clusters:
        return {}
    linear = solve(parameters_of(model.rig, model.terms, family), clusters)
    solution = reduced(model.rig, model.terms, linear, clusters)
    return dict(zip(solution.names, solution.value, strict=True))


def _scatter(values: Array) -> Scatter:
    mean = float(values.mean())
    rsd = 100.0 * float(values.std(ddof=1)) / abs(mean) if mean else float("nan")
    return Scatter(float(values.min()), mean, float(values.max()), rsd, len(values))
