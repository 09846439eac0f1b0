"""The exact fit of all linear coefficients at given shapes, and its derivatives.

The rows of the averaged records are computed at the shapes, and the coefficients are solved for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, Shape, shapes_of
from analysis.regression.least_squares import column_scale
from analysis.regression.rows import in_common, matrix_of, parameters_of
from analysis.terms.base import Used, family_of
from analysis.trace.data.conditioned_record import (
    acting_on,
    model_rows,
    shared_rows,
)
from analysis.trace.data.noise_floor import stated_noise
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.settings import TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class DesignMatrix:
    """Whitened rows of a model on regression data: matrix (M, k) of `names`, right side (M,).

    `cavitating` are, for each equation with such rows, the rows (numbers) at which the oil does
    not cavitate under the model and those at which it does.
    """

    names: tuple[str, ...]
    matrix: Array
    rhs: Array
    cavitating: tuple[tuple[Indices, Indices], ...] = ()

    def residual(self, beta: Mapping[str, float]) -> Array:
        """Return the residual (M,) under coefficients of the rows.

        Where the oil cavitates no flow can be compared. Up to `TRACE.cavitating_share` of an
        equation's rows such instants are limited to the rms of the others, so that they count
        neither for nor against the model: a true gain of a sensor puts some pressures below zero.
        """
        out = self.rhs - self.matrix @ np.array([beta.get(n, 0.0) for n in self.names])
        for others, outside in self.cavitating:
            if len(outside) <= TRACE.cavitating_share * (len(outside) + len(others)):
                limit = np.sqrt(np.mean(out[others] ** 2))
                out[outside] = np.clip(out[outside], -limit, limit)
        return np.asarray(out)


@dataclass(frozen=True)
class ExactFit:
    """A fitted model: terms with shapes, coefficients of the rows, whitened residual (M,).

    `information` (k, k) of the coefficients, in the order of `beta`, is the inverse of their
    covariance from noise.
    """

    terms: tuple[Used, ...]
    beta: Mapping[str, float]
    residual: Array
    information: Array

    @property
    def energy(self) -> float:
        """Energy of the whitened residual."""
        return float(self.residual @ self.residual)

    def parameters(self, rig: Rig) -> dict[str, float]:
        """Return the parameters by name."""
        return parameter_values(rig, self.terms, self.beta)


def parameter_values(
    rig: Rig, terms: Sequence[Used], beta: Mapping[str, float]
) -> dict[str, float]:
    """Return parameters from the rows' coefficients (b from 1/b), NaN without a coefficient."""
    out = {}
    for used in terms:
        for c in used.term.coefficients(rig):
            value = float(beta.get(c.parameter, np.nan))
            out[c.parameter] = 1.0 / value if c.reciprocal and value else value
    return out


def design_matrix(data: RegressionData, terms: Sequence[Used]) -> DesignMatrix:
    """Return the whitened rows of a model at the instants of the averaged records.

    Instants that the model masks keep the residual of the data's own model (but see
    `DesignMatrix.residual`): otherwise an effect could remove a residual by moving signals to where
    the equations do not hold.
    """
    names = _coefficient_names(data.rig, terms)
    X, y = np.zeros((data.base.shape[0], len(names))), np.zeros(data.base.shape[0])
    cavitating: list[tuple[Indices, Indices]] = []
    for family, rows in data.family_rows.items():
        of_family = _family_design(data, family, acting_on(data.rig, terms, family, data.cache))
        columns = np.array([names.index(n) for n in of_family.names], dtype=np.int64)
        X[np.ix_(rows, columns)] = of_family.matrix
        y[rows] = of_family.rhs
        cavitating += [(rows[others], rows[outside]) for others, outside in of_family.cavitating]
    return DesignMatrix(names, X, y, tuple(cavitating))


def _coefficient_names(rig: Rig, terms: Sequence[Used]) -> tuple[str, ...]:
    """Return the coefficients of terms, each once, in the terms' order."""
    return tuple(dict.fromkeys(c.parameter for u in terms for c in u.term.coefficients(rig)))


def _family_design(data: RegressionData, family: str, terms: Sequence[Used]) -> DesignMatrix:
    """Return `design_matrix` of one family's rows (`RegressionData.family_rows`) and terms."""
    names = parameters_of(data.rig, terms, family)
    built = {
        c.group: (rows, shared_rows(data.rig, terms, replace(c, families=(family,)), data.cache))
        for c, rows in zip(data.records, data.rows, strict=True)
    }
    of_family = data.family_rows[family]
    rescaled = data.relative and rescale(data, terms)
    X, y = np.zeros((len(of_family), len(names))), data.mean_residual[of_family]
    valid = np.zeros(len(of_family), dtype=bool)
    of_equation: dict[str, list[Indices]] = {}
    start = 0
    for segment in data.segments:
        if family_of(segment.equation) != family:
            continue
        before, rows = (side[segment.equation] for side in built[segment.group])
        in_before, in_rows = in_common(before, rows)
        rescaling = 1.0
        if rescaled and rows.rhs[in_rows].size:  # about the mean, a difference of two large forces
            old, new = np.std(before.rhs[in_before]), np.std(rows.rhs[in_rows])
            rescaling = float(old) / max(float(new), 1e-300)
        weight = np.sqrt(segment.repeats) / segment.noise * rescaling
        rows_of_segment = slice(start, start + len(before.rhs))
        X[rows_of_segment][in_before] = matrix_of(rows, names)[in_rows] * weight
        y[rows_of_segment][in_before] = rows.rhs[in_rows] * weight
        valid[rows_of_segment][in_before] = True
        numbers = np.arange(start, rows_of_segment.stop)
        of_equation.setdefault(segment.equation, []).append(numbers)
        start = rows_of_segment.stop
    equations = () if valid.all() else map(np.concatenate, of_equation.values())
    cavitating = ((n[valid[n]], n[~valid[n]]) for n in equations if not valid[n].all())
    return DesignMatrix(names, X, y, tuple(cavitating))


def _family_fit(data: RegressionData, family: str, terms: tuple[Used, ...]) -> ExactFit:
    """Return the least-squares fit of one family's rows."""
    rows = _family_design(data, family, terms)
    scale = column_scale(rows.matrix)
    Q, R = np.linalg.qr(rows.matrix / scale)
    values = np.linalg.lstsq(R, Q.T @ rows.rhs, rcond=TRACE.rank_limit)[0] / scale
    beta = dict(zip(rows.names, values, strict=True))
    return ExactFit(terms, beta, rows.residual(beta), (R * scale).T @ (R * scale))


def fit_coefficients(data: RegressionData, terms: Sequence[Used]) -> ExactFit:
    """Return the least-squares fit of a model's coefficients, with its shapes as given.

    Families of rows share no coefficient: each is fitted separately, and not again where the change
    of a shape leaves it unchanged.
    """
    names = _coefficient_names(data.rig, terms)
    beta, information = dict.fromkeys(names, 0.0), np.zeros((len(names), len(names)))
    residual = np.zeros(data.base.shape[0])
    for family, rows in data.family_rows.items():
        acting = acting_on(data.rig, terms, family, data.cache)
        of_family: ExactFit = data.cache.fits.get(
            (family, data.terms, acting, data.relative), partial(_family_fit, data, family, acting)
        )
        places = [names.index(n) for n in of_family.beta]
        beta |= of_family.beta
        residual[rows] = of_family.residual
        information[np.ix_(places, places)] = of_family.information
    return ExactFit(tuple(terms), beta, residual, information)


def jacobian(data: RegressionData, model: ExactFit, used: Used) -> tuple[tuple[str, ...], Array]:
    """Return names and whitened columns (M, p) of an effect's coefficients and shapes.

    A column is the derivative of the model's side of the rows with respect to the parameter.
    """
    rows = design_matrix(data, model.terms)
    coefficients = [c.parameter for c in used.term.coefficients(data.rig)]
    names, columns = list(coefficients), [rows.matrix[:, rows.names.index(n)] for n in coefficients]
    for j, shape in enumerate(shapes_of(data.rig, used)):
        if shape.fixed or not shape.is_present(used.shape[j]):
            continue
        step = 1e-3 * (shape.high - shape.low)
        if is_logarithmic(shape):
            step = 1e-2 * used.shape[j]
        up = min(used.shape[j] + step, shape.high)
        down = max(used.shape[j] - step, shape.low)
        residuals = []
        for value in (up, down):
            changed = Used(used.term, (*used.shape[:j], value, *used.shape[j + 1 :]))
            residuals.append(
                design_matrix(data, with_term(model.terms, used, changed)).residual(model.beta)
            )
        names.append(shape.parameter)
        columns.append(-(residuals[0] - residuals[1]) / (up - down))
    stack = np.column_stack(columns) if columns else np.zeros((len(model.residual), 0))
    return tuple(names), stack


def tangent(data: RegressionData, model: ExactFit) -> tuple[tuple[str, ...], Array]:
    """Return names and whitened derivatives (M, p) of all coefficients and shapes of a model."""
    rows = design_matrix(data, model.terms)
    names, columns = list(rows.names), [rows.matrix]
    for used in model.terms:
        if used.shape and isinstance(used.term, Effect):
            effect_names, J = jacobian(data, model, used)
            new = [k for k, n in enumerate(effect_names) if n not in names]
            names += [effect_names[k] for k in new]
            columns.append(J[:, new])
    return tuple(names), np.column_stack(columns)


def contribution(data: RegressionData, model: ExactFit, used: Used) -> Array:
    """Return an effect's part of the whitened rows (M,): its derivatives times its values."""
    _, J = jacobian(data, model, used)
    amounts = [model.beta.get(c.parameter, 0.0) for c in used.term.coefficients(data.rig)]
    for shape, value in zip(shapes_of(data.rig, used), used.shape, strict=True):
        if not shape.fixed and shape.is_present(value):
            amounts.append(value if shape.neutral is not None else 0.0)
    return np.asarray(J @ np.array(amounts))


def rebased(data: RegressionData, model: ExactFit) -> RegressionData:
    """Return the regression data with a fitted model as its own model."""
    rows = design_matrix(data, model.terms)
    all_rows = []
    for conditioned, before in zip(data.records, data.rows, strict=True):
        after = shared_rows(data.rig, model.terms, conditioned, data.cache)
        aligned = {}
        for equation, old in before.items():
            new = after[equation]
            in_old, in_new = in_common(old, new)
            matrix, rhs = np.zeros((len(old.rhs), len(new.names))), np.zeros(len(old.rhs))
            matrix[in_old], rhs[in_old] = new.matrix[in_new], new.rhs[in_new]
            aligned[equation] = replace(new, matrix=matrix, rhs=rhs, time=old.time)
        all_rows.append(aligned)
    return replace(
        data, terms=model.terms, beta=dict(model.beta), names=rows.names, base=rows.matrix,
        rows=tuple(all_rows),
    )  # fmt: skip


def with_term(terms: Sequence[Used], used: Used, other: Used) -> tuple[Used, ...]:
    """Return the terms with `other` in place of `used`."""
    return tuple(other if u is used else u for u in terms)


def rescale(data: RegressionData, terms: Sequence[Used]) -> bool:
    """Return whether a term that is not the data's own multiplies signals."""
    return any(
        isinstance(u.term, Effect) and u.term.rescales and u not in data.terms for u in terms
    )


def is_logarithmic(shape: Shape) -> bool:
    """Return whether a shape's bounds differ by a factor so large that its logarithm is used."""
    return shape.low > 0 and shape.high / shape.low > 20


def noise_amplification(data: RegressionData, fit: ExactFit) -> Array:
    """Return how many times larger the stated noise is in each row (M,) with the effects of a fit.

    To undo a sensor's lag multiplies fast noise of its channel. The factor is the ratio of the
    equation's rms by stated noise under the fit's terms and under the data's own, at least 1.
    """
    factors = np.ones(len(data.base))
    for average, of_average in zip(data.records, data.rows, strict=True):
        conditioned, rows = average, of_average
        if average.repeats:  # the averaged channels belong to no motion
            conditioned = average.repeats[0]
            rows = model_rows(data.rig, data.terms, conditioned)
        after = shared_rows(data.rig, fit.terms, conditioned, data.cache)
        noise = stated_noise(data.rig, data.terms, conditioned, rows, data.beta)
        amplified = stated_noise(data.rig, fit.terms, conditioned, after, fit.beta)
        for s in data.segments:
            if s.group == conditioned.group and noise[s.equation] > 0.0:
                factors[s.where] = max(1.0, amplified[s.equation] / noise[s.equation])
    return factors


def over_amplified_noise(data: RegressionData, fit: ExactFit, residual: Array) -> Array:
    """Return a whitened residual (M,) over the noise that effects of the fit amplify, if any do."""
    if not any(isinstance(u.term, Effect) and u.term.amplifies for u in fit.terms):
        return residual
    return np.asarray(residual / noise_amplification(data, fit))
