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
from analysis.regression.rows import in_common, matrix_of, parameters_of
from analysis.terms.base import Used, family_of
from analysis.trace.data.conditioned_record import acting_on, shared_rows
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
        equation's rows such instants keep at most the rms of the others, so that they count
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

    Instants that the model masks have the residual of the data's own model, so that no effect
    removes a residual by moving signals to where the equations do not hold (but see
    `DesignMatrix.residual`).
    """
    names = _coefficient_names(data.rig, terms)
    X, y = np.zeros((data.base.shape[0], len(names))), np.zeros(data.base.shape[0])
    cavitating: list[tuple[Indices, Indices]] = []
    for family, rows in data.family_rows.items():
        own = _family_design(data, family, acting_on(data.rig, terms, family, data.cache))
        columns = np.array([names.index(n) for n in own.names], dtype=np.int64)
        X[np.ix_(rows, columns)] = own.matrix
        y[rows] = own.rhs
        cavitating += [(rows[others], rows[outside]) for others, outside in own.cavitating]
    return DesignMatrix(names, X, y, tuple(cavitating))


def _coefficient_names(rig: Rig, terms: Sequence[Used]) -> tuple[str, ...]:
    """Return the coefficients of terms, each once, in the terms' order."""
    return tuple(dict.fromkeys(c.parameter for u in terms for c in u.term.coefficients(rig)))


def _family_design(data: RegressionData, family: str, terms: Sequence[Used]) -> DesignMatrix:
    """Return `design_matrix` of one family's rows (`RegressionData.family_rows`) and terms."""
    names = parameters_of(data.rig, terms, family)
    built = {
        record.group: (
            rows,
            shared_rows(data.rig, terms, replace(record, families=(family,)), data.cache),
        )
        for record, rows in zip(data.records, data.rows, strict=True)
    }
    own_rows = data.family_rows[family]
    rescaled = data.relative and rescale(data, terms)
    X, y = np.zeros((len(own_rows), len(names))), data.mean_residual[own_rows]
    kept: dict[str, list[Indices]] = {}
    every: dict[str, list[Indices]] = {}
    start = 0
    for segment in data.segments:
        if family_of(segment.equation) != family:
            continue
        before, rows = (side[segment.equation] for side in built[segment.group])
        here, there = in_common(before, rows)
        size = 1.0
        if rescaled and rows.rhs[there].size:  # about the mean, a difference of two large forces
            size = float(np.std(before.rhs[here])) / max(float(np.std(rows.rhs[there])), 1e-300)
        weight = np.sqrt(segment.repeats) / segment.noise * size
        own = np.arange(start, start + len(before.rhs))
        inside = slice(start, start + len(own))
        X[inside][here] = matrix_of(rows, names)[there] * weight
        y[inside][here] = rows.rhs[there] * weight
        kept.setdefault(segment.equation, []).append(own[here])
        every.setdefault(segment.equation, []).append(own)
        start += len(own)
    return DesignMatrix(names, X, y, _cavitating(kept, every))


def _cavitating(
    kept: Mapping[str, Sequence[Indices]], every: Mapping[str, Sequence[Indices]]
) -> tuple[tuple[Indices, Indices], ...]:
    """Return the rows `kept` by a model and the others of all, of equations that have others."""
    out = []
    for equation, parts in kept.items():
        if sum(map(len, parts)) < sum(map(len, every[equation])):  # seldom
            here = np.concatenate(parts)
            out.append((here, np.setdiff1d(np.concatenate(every[equation]), here)))
    return tuple(out)


def _family_fit(data: RegressionData, family: str, terms: tuple[Used, ...]) -> ExactFit:
    """Return the fit of one family's rows."""
    rows = _family_design(data, family, terms)
    scale = np.linalg.norm(rows.matrix, axis=0)
    scale[scale == 0] = 1.0
    Q, R = np.linalg.qr(rows.matrix / scale)
    values = np.linalg.lstsq(R, Q.T @ rows.rhs, rcond=TRACE.rank_limit)[0] / scale
    beta = dict(zip(rows.names, values, strict=True))
    return ExactFit(terms, beta, rows.residual(beta), (R * scale).T @ (R * scale))


def fit_coefficients(data: RegressionData, terms: Sequence[Used]) -> ExactFit:
    """Return the least-squares fit of a model's coefficients, with its shapes as given.

    No coefficient is shared between families of rows, so that each family is fitted by itself, and
    one in which no shape acts is not fitted again.
    """
    names = _coefficient_names(data.rig, terms)
    beta, information = dict.fromkeys(names, 0.0), np.zeros((len(names), len(names)))
    residual = np.zeros(data.base.shape[0])
    for family, rows in data.family_rows.items():
        acting = acting_on(data.rig, terms, family, data.cache)
        own: ExactFit = data.cache.fits.get(
            (family, data.terms, acting, data.relative), partial(_family_fit, data, family, acting)
        )
        at = [names.index(n) for n in own.beta]
        beta |= own.beta
        residual[rows] = own.residual
        information[np.ix_(at, at)] = own.information
    return ExactFit(tuple(terms), beta, residual, information)


def jacobian(data: RegressionData, model: ExactFit, used: Used) -> tuple[tuple[str, ...], Array]:
    """Return names and whitened columns (M, p) of an effect's coefficients and shapes.

    A column is the derivative of the model's side of the rows with respect to the parameter.
    """
    rows = design_matrix(data, model.terms)
    own = [c.parameter for c in used.term.coefficients(data.rig)]
    names, columns = list(own), [rows.matrix[:, rows.names.index(n)] for n in own]
    for j, shape in enumerate(shapes_of(data.rig, used)):
        if shape.fixed or not shape.is_present(used.shape[j]):
            continue
        step = 1e-3 * (shape.high - shape.low)
        if is_logarithmic(shape):
            step = 1e-2 * used.shape[j]
        up = min(used.shape[j] + step, shape.high)
        down = max(used.shape[j] - step, shape.low)
        ends = []
        for value in (up, down):
            changed = Used(used.term, (*used.shape[:j], value, *used.shape[j + 1 :]))
            ends.append(
                design_matrix(data, with_term(model.terms, used, changed)).residual(model.beta)
            )
        names.append(shape.parameter)
        columns.append(-(ends[0] - ends[1]) / (up - down))
    stack = np.column_stack(columns) if columns else np.zeros((len(model.residual), 0))
    return tuple(names), stack


def tangent(data: RegressionData, model: ExactFit) -> tuple[tuple[str, ...], Array]:
    """Return names and whitened derivatives (M, p) of all coefficients and shapes of a model."""
    rows = design_matrix(data, model.terms)
    names, columns = list(rows.names), [rows.matrix]
    for used in model.terms:
        if used.shape and isinstance(used.term, Effect):
            own, J = jacobian(data, model, used)
            fresh = [k for k, n in enumerate(own) if n not in names]
            names += [own[k] for k in fresh]
            columns.append(J[:, fresh])
    return tuple(names), np.column_stack(columns)


def contribution(data: RegressionData, model: ExactFit, used: Used) -> Array:
    """Return what an effect adds to the whitened rows (M,): its derivatives times its values."""
    _, J = jacobian(data, model, used)
    amounts = [model.beta.get(c.parameter, 0.0) for c in used.term.coefficients(data.rig)]
    for shape, value in zip(shapes_of(data.rig, used), used.shape, strict=True):
        if not shape.fixed and shape.is_present(value):
            amounts.append(value if shape.neutral is not None else 0.0)
    return np.asarray(J @ np.array(amounts))


def rebased(data: RegressionData, model: ExactFit) -> RegressionData:
    """Return regression data whose own model is a fitted model."""
    rows = design_matrix(data, model.terms)
    built = []
    for conditioned, before in zip(data.records, data.rows, strict=True):
        now = shared_rows(data.rig, model.terms, conditioned, data.cache)
        kept = {}
        for equation, old in before.items():
            here, there = in_common(old, now[equation])
            matrix = np.zeros((len(old.rhs), len(now[equation].names)))
            rhs = np.zeros(len(old.rhs))
            matrix[here], rhs[here] = now[equation].matrix[there], now[equation].rhs[there]
            kept[equation] = replace(now[equation], matrix=matrix, rhs=rhs, time=old.time)
        built.append(kept)
    return replace(
        data, terms=model.terms, beta=dict(model.beta), names=rows.names, base=rows.matrix,
        rows=tuple(built),
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
    """Return whether the bounds of a shape lie so far apart that its logarithm is searched."""
    return shape.low > 0 and shape.high / shape.low > 20
