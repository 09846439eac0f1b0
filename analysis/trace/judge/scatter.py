"""Errors of an effect's parameters: scatter between repeats, and errors of the effect's form.

The rows' influence on a parameter is grouped as in `analysis.identify.estimators.covariance`: by
repeat, by the part of the excitation's period, and by the level of the state that a law depends on
(a chamber's pressure; a piston's position and its speed). Differences between groups beyond noise
come from a model error that is the same in every repeat, and enter as a systematic part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shapes_of
from analysis.identify.estimators.covariance import CovarianceParts, spread
from analysis.identify.estimators.equations import Pieces, segments
from analysis.identify.geometry import wider
from analysis.identify.settings import IDENTIFY
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.least_squares import column_scale
from analysis.simulation.model import Model
from analysis.terms.base import joint_of
from analysis.trace.data.regression_data import RegressionData, Segment
from analysis.trace.search.exact_fit import ExactFit, contribution, design_matrix, tangent
from analysis.trace.search.refinement import fits_in_other_forms
from analysis.trace.settings import SEARCH, TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PERIOD, STATE, SPEED = "period", "state", "speed"


def parameter_covariance(
    train_data: RegressionData, columns: Array, residual: Array
) -> CovarianceParts:
    """Return the covariance of the coefficients of `columns` (M, k).

    The columns are orthogonal to all other columns of the model; `residual` (M,) is the whitened
    residual of the averaged records. Where columns depend on each other, the covariance is that of
    the combinations that the rows determine, and every coefficient has the least dof of these.
    """
    size, V = np.linalg.eigh(columns.T @ columns)
    determined = V[:, size > TRACE.eigenvalue_ratio * max(float(size[-1]), 1e-300)]
    if determined.shape[1] < len(V):
        k = len(V)
        if not determined.shape[1]:
            return CovarianceParts(np.zeros((k, k)), np.ones(k), np.zeros(k))
        reduced = parameter_covariance(train_data, columns @ determined, residual)
        covariance = determined @ reduced.covariance @ determined.T
        return CovarianceParts(
            covariance, np.full(k, reduced.dof.min()), np.full(k, reduced.systematic.max())
        )
    inverse = np.asarray((V / size) @ V.T, dtype=np.float64)
    groupings = [_scores(train_data, columns, residual, by) for by in (PERIOD, STATE, SPEED)]
    return spread(groupings, inverse)


def _scores(train_data: RegressionData, columns: Array, residual: Array, by: str) -> Pieces:
    """Return scores and information of every step, repeat and group of rows.

    Rows are grouped `by` PERIOD, STATE or SPEED.
    """
    strata = {g: k for k, g in enumerate(sorted({s.group for s in train_data.segments}))}
    pieces: dict[tuple[int, int, int], tuple[Array, Array]] = {}
    for number, s in enumerate(train_data.segments):
        conditioned, rows = train_data.source(s)
        label = _row_groups(conditioned, s, rows.time, by)
        # Parts of a period group all equations; levels of a state group each equation by itself.
        label = label if by == PERIOD else label + number * IDENTIFY.state_levels
        weighted = columns[s.where] / np.sqrt(s.repeats)
        repeats = train_data.residual[: s.repeats, s.where]
        noise = repeats - repeats.mean(axis=0) + residual[s.where] / np.sqrt(s.repeats)
        for part in np.unique(label):
            in_group = label == part
            information = weighted[in_group].T @ weighted[in_group]
            for repeat in range(s.repeats):
                key = (strata[s.group], repeat, int(part))
                score = weighted[in_group].T @ noise[repeat, in_group]
                before = pieces.get(key, (0.0, 0.0))
                pieces[key] = (score + before[0], information + before[1])
    keys = np.array(list(pieces), dtype=np.int64)
    return Pieces(
        keys[:, 0], keys[:, 1], keys[:, 2],
        np.array([g for g, _ in pieces.values()]), np.array([a for _, a in pieces.values()]),
    )  # fmt: skip


def _row_groups(conditioned: ConditionedRecord, s: Segment, time: Array, by: str) -> Indices:
    """Return the group of each row (m,): part of the period, or level of a state."""
    record = conditioned.record
    if by == PERIOD:
        return segments(time, record.period / record.sample_rate)
    signals, at = conditioned.signals, conditioned.samples_at(time)
    kind, i = s.equation.rsplit("_", 1)[0], joint_of(s.equation)
    state = {"flow_cap": signals.p_cap, "flow_rod": signals.p_rod}.get(kind, signals.s)
    x = (signals.sd if by == SPEED else state)[at, i]
    rank = np.argsort(np.argsort(x))
    return np.asarray(rank * IDENTIFY.state_levels // max(len(rank), 1), dtype=np.int64)


def form_shift(train_data: RegressionData, fit: ExactFit) -> dict[str, float]:
    """Return the possible error of every coefficient and shape by unknown forms, by name.

    Two errors are added as squares. (1) Where an effect has another form
    (`Effect.other_form_starts`), that is fitted too and shifts each coefficient, except those of
    the effect whose meaning differs between the forms. The shift counts by sqrt(E / (E + D)), with
    E the energy above noise that is left in the rows on which the effect acts, at least
    `TRACE.form_noise`, and D what the other form leaves more: in full where the other is as good,
    not at all where it is physically impossible. (2) An effect may not grow in proportion, with
    x (1 + e |x| / rms x) in place of its contribution x to the rows. Where e exceeds
    `TRACE.standard_errors` of its noise, the shift that it makes counts.
    """
    rig, squares = train_data.rig, _growth_shift_squares(train_data, fit)
    for used, other in fits_in_other_forms(train_data, fit):
        values = other.parameters(rig)
        effects = [(u.term, u.shape) for u in other.terms if isinstance(u.term, Effect)]
        if any(e.problem(rig, values, s) or e.outside(rig, s) for e, s in effects):
            continue
        residual = fit.residual[contribution(train_data, fit, used) != 0.0]
        excess = max(float(residual @ residual) - len(residual), TRACE.form_noise)
        share = excess / (excess + max(0.0, other.energy - fit.energy))
        incomparable = _incomparable_coefficients(rig, fit, other)
        own = {**fit.beta, **fitted_shapes(rig, fit)}
        for name, value in {**other.beta, **fitted_shapes(rig, other)}.items():
            if name in incomparable:
                continue
            shift = value - own.get(name, value)
            squares[name] = squares.get(name, 0.0) + share * shift**2
    return {name: float(np.sqrt(v)) for name, v in squares.items()}


def fitted_shapes(rig: Rig, fit: ExactFit) -> dict[str, float]:
    """Return the shapes of a fit's effects that are present and not fixed, by name."""
    return {
        shape.parameter: value
        for used in fit.terms
        for shape, value in zip(shapes_of(rig, used), used.shape, strict=True)
        if shape.is_present(value) and not shape.fixed
    }


def _incomparable_coefficients(rig: Rig, fit: ExactFit, other: ExactFit) -> set[str]:
    """Return the coefficients of effects whose other form gives them another meaning."""
    return {
        c.parameter
        for used, changed in zip(fit.terms, other.terms, strict=True)
        if isinstance(used.term, Effect)
        and not used.term.coefficients_comparable(used.shape, changed.shape)
        for c in used.term.coefficients(rig)
    }


def _growth_shift_squares(train_data: RegressionData, fit: ExactFit) -> dict[str, float]:
    """Return the squared shifts by effects that do not grow in proportion (2), by name."""
    names, X = tangent(train_data, fit)
    scale = column_scale(X)
    squares = dict.fromkeys(names, 0.0)
    for used in fit.terms:
        if not isinstance(used.term, Effect) or used.term.free:
            continue
        x = contribution(train_data, fit, used)
        size = float(np.sqrt(np.mean(x[x != 0.0] ** 2))) if x.any() else 1.0
        column = x * np.abs(x) / size
        moved = np.linalg.lstsq(X / scale, column, rcond=1e-6)[0]
        projected = column - X @ (moved / scale)
        energy = float(projected @ projected)
        if energy <= SEARCH.least_projected_length**2 * float(column @ column):
            continue
        e = float(projected @ fit.residual) / energy
        if abs(e) * np.sqrt(energy) > TRACE.standard_errors:
            for name, shift in zip(names, e * moved / scale, strict=True):
                squares[name] += float(shift) ** 2
    return squares


def with_form_errors(
    train_data: RegressionData, fit: ExactFit, model: Model, shift: Mapping[str, float]
) -> Model:
    """Return the model with intervals that include the uncertainty of shapes and forms.

    `model` was identified with the shapes taken as exact. With shapes t of covariance S, X the
    columns of the coefficients, J_t those of the shapes and A = X'X, to first order
    beta(t) = beta - A^-1 X' J_t (t - t0). Variances grow by that of beta(t), and by the square of
    `shift`, which `form_shift` returns.
    """
    rows = design_matrix(train_data, fit.terms)
    size = np.linalg.norm(rows.matrix, axis=0)
    unit = rows.matrix / column_scale(rows.matrix)
    variance = _variance_from_shapes(train_data, fit, unit, rows.names)
    errors = {}
    for k, name in enumerate(rows.names):
        old = model.parameters.get(name)
        if old is None or not old.identified or size[k] == 0:
            continue
        # The rows may hold the reciprocal: relative sizes are the same.
        error = np.hypot(np.sqrt(variance[k]) / size[k], shift.get(name, 0.0))
        errors[name] = abs(old.value) * float(error / abs(fit.beta[name]))
    return with_errors(model, errors)


def with_errors(model: Model, errors: Mapping[str, float]) -> Model:
    """Return the model with further standard errors of parameters, by name, in quadrature."""
    names = list(model.parameters)
    parameters, covariance = dict(model.parameters), model.covariance.copy()
    for name, std in errors.items():
        parameters[name] = wider(parameters[name], std)
        covariance[names.index(name), names.index(name)] += std**2
    return replace(model, parameters=parameters, covariance=covariance)


def _variance_from_shapes(
    train_data: RegressionData, fit: ExactFit, X: Array, coefficients: Sequence[str]
) -> Array:
    """Return the variance (k,) of the coefficients of X (M, k) by the covariance of the shapes."""
    names, columns = tangent(train_data, fit)
    shapes = columns[:, [k for k, n in enumerate(names) if n not in coefficients]]
    shapes = shapes[:, np.linalg.norm(shapes, axis=0) > 0]
    if not shapes.shape[1]:
        return np.zeros(X.shape[1])
    unit = shapes / np.linalg.norm(shapes, axis=0)
    moved = np.linalg.lstsq(X, unit, rcond=1e-6)[0]
    error = parameter_covariance(train_data, unit - X @ moved, fit.residual)
    variance = np.einsum("ki,ij,kj->k", moved, error.covariance, moved)
    return np.asarray(np.maximum(variance, 0.0))
