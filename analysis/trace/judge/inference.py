"""Significance of an effect by sign flips, and standard errors of its parameters.

Under the null hypothesis a residual is noise, symmetric and independent from repeat to repeat, so
that the signs of whole repeats may be flipped. With few repeats, flips of whole records cannot give
a small p (4 repeats: not below 1/8). Then blocks of a record are flipped: whole periods where the
record holds at least three, else `TRACE.flip_block` seconds. The noise behind the row filter is
uncorrelated after a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values, shapes_of
from analysis.identify.geometry import wider
from analysis.identify.settings import IDENTIFY
from analysis.regression.least_squares import column_scale
from analysis.regression.solve import half_width
from analysis.simulation.model import Estimate, Model
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in, effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.scatter import form_shift, parameter_covariance, with_form_errors
from analysis.trace.search.exact_fit import ExactFit, jacobian, tangent
from analysis.trace.search.hypothesis import of_one_law
from analysis.trace.search.linear_fit import CandidateColumns, orthonormal
from analysis.trace.search.refinement import ShapeFit
from analysis.trace.settings import TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]


def flip_blocks(train_data: RegressionData) -> NDArray[np.int64]:
    """Return for each row (M,) the number of its block within its record.

    With `TRACE.enough_repeats` a record is one block; else a block is a period if the record holds
    at least three, or `TRACE.flip_block` seconds.
    """
    out = np.zeros(train_data.base.shape[0], dtype=np.int64)
    for segment in train_data.segments:
        if segment.repeats >= TRACE.enough_repeats:
            continue
        conditioned, rows = train_data.source(segment)
        rate, period = conditioned.record.sample_rate, conditioned.record.period
        time, length = rows.time, TRACE.flip_block
        if period and 3 * period <= conditioned.record.samples:
            length = period / rate
        out[segment.where] = np.floor((time - time[0]) / length).astype(np.int64)
    return out


def sign_flipped(train_data: RegressionData, rng: np.random.Generator, residual: Array) -> Array:
    """Return averages (M, flips) of `residual` (R, M) after random sign flips of its blocks."""
    count = TRACE.sign_flips
    numbers = flip_blocks(train_data)
    M = train_data.base.shape[0]
    out = np.zeros((M, count))
    groups = sorted({s.group for s in train_data.segments})
    most_blocks = int(numbers.max()) + 1
    for group in groups:
        parts = [s for s in train_data.segments if s.group == group]
        signs = rng.choice([-1.0, 1.0], size=(parts[0].repeats, most_blocks, count))
        for s in parts:
            repeats = residual[: s.repeats, s.where]
            sums = np.einsum("rm,rmc->mc", repeats, signs[:, numbers[s.where], :])
            out[s.where] = sums / np.sqrt(s.repeats)
    return out


def null_maximum(
    candidates: CandidateColumns,
    train_data: RegressionData,
    residual: Array,
    rng: np.random.Generator,
) -> Array:
    """Return the largest energy (flips,) that any candidate at any shape removes, by flip."""
    r = sign_flipped(train_data, rng, residual)
    r = r - candidates.basis @ (candidates.basis.T @ r)
    c = candidates.columns.T @ r
    diagonal = np.diag(candidates.K)
    shows = diagonal > candidates.visibility_limit
    best = (
        np.max(c[shows] ** 2 / diagonal[shows, None], axis=0)
        if shows.any()
        else np.zeros(TRACE.sign_flips)
    )
    for group in candidates.groups:
        j = [k for k in group if shows[k]]
        if len(j) > 1:
            inverse = np.linalg.pinv(candidates.K[np.ix_(j, j)], rcond=1e-6, hermitian=True)
            best = np.maximum(best, np.einsum("ib,ij,jb->b", c[j], inverse, c[j]))
    return np.asarray(best)


def p_value(gain: float, null: Array) -> float:
    """Return the family-wise p of a removed energy `gain` against those under flips (`null`)."""
    return float((1 + np.sum(null >= gain)) / (1 + len(null)))


@dataclass(frozen=True)
class EffectErrors:
    """An effect's parameters (k,), standard errors (k,) and degrees of freedom (k,) of their t."""

    names: tuple[str, ...]
    value: Array
    std: Array
    dof: Array


def effect_errors(train_data: RegressionData, model: ExactFit, used: Used) -> EffectErrors:
    """Return an effect's parameters with errors from repeats and lack of fit."""
    names, J = jacobian(train_data, model, used)
    base = basis_of_others(train_data, model, names)
    J_p = J - base @ (base.T @ J)
    scale = column_scale(J_p)  # units differ by many powers of ten
    error = parameter_covariance(train_data, J_p / scale, model.residual)
    known = {**shape_values(train_data.rig, used), **model.parameters(train_data.rig)}
    value = np.array([known.get(n, np.nan) for n in names])
    return EffectErrors(names, value, np.sqrt(np.diag(error.covariance)) / scale, error.dof)


def estimates(
    train_data: RegressionData, used: Used, errors: EffectErrors, shift: Mapping[str, float]
) -> dict[str, Estimate]:
    """Return an effect's parameters with 95 % intervals.

    They include the errors by unknown forms (`shift`), and the range of what only the form gives
    beyond the records.
    """
    rig = train_data.rig
    units = {c.parameter: c.unit for c in used.term.coefficients(rig)}
    units |= {s.parameter: s.unit for s in shapes_of(rig, used)}
    half = half_width(errors.std, errors.dof)
    out = {
        name: with_form_error(
            Estimate(float(v), units.get(name, ""), float(s), (float(v - h), float(v + h))),
            shift.get(name, 0.0),
        )
        for name, v, s, h in zip(errors.names, errors.value, errors.std, half, strict=True)
    }
    signals = [conditioned.signals for conditioned in train_data.records]
    for name, range_beyond in effect_in(used).extrapolated(rig, signals, used.shape).items():
        if name in out:
            low, high = out[name].ci95
            out[name] = replace(out[name], ci95=(min(low, *range_beyond), max(high, *range_beyond)))
    return out


def with_form_error(estimate: Estimate, shift: float) -> Estimate:
    """Return an estimate whose interval includes the standard error `shift` by unknown forms.

    Another form changes a size by a factor but not its sign: an interval that excludes 0 still
    does.
    """
    (low, high), out = estimate.ci95, wider(estimate, shift)
    if not low * high > 0.0:
        return out
    factor = 1.0 + IDENTIFY.normal_quantile * shift / abs(estimate.value)
    if low > 0.0:
        return replace(out, ci95=(max(out.ci95[0], low / factor), out.ci95[1]))
    return replace(out, ci95=(out.ci95[0], min(out.ci95[1], high / factor)))


def all_include(values: Mapping[str, float], parameters: Mapping[str, Estimate]) -> bool:
    """Return whether the 95 % interval of each parameter that has a value includes it.

    False where none of `values` is that of one of the `parameters`.
    """
    intervals = [
        (value, *parameters[name].ci95) for name, value in values.items() if name in parameters
    ]
    return bool(intervals) and all(low <= value <= high for value, low, high in intervals)


def is_of_unknown_size(
    rig: Rig, used: Used, parameters: Mapping[str, Estimate], effects: Sequence[Used]
) -> bool:
    """Return whether rows do not determine how an effect and another share one force or flow.

    The 95 % intervals of all its coefficients (among `parameters`, by name) hold zero, and one of
    the other `effects` of its family, but of another law, acts at its place: two frictions of one
    joint.
    """
    effect = effect_in(used)
    zeros = {c.parameter: 0.0 for c in effect.coefficients(rig)}
    if effect.free or not all_include(zeros, parameters):
        return False
    family = effect.family, effect.where
    others = effects_among(o for o in effects if o is not used)
    return any((o.family, o.where) == family and not of_one_law(o, effect) for o in others)


def with_shape_errors(shape_fit: ShapeFit, model: Model) -> tuple[Model, dict[str, Estimate]]:
    """Return the model with wider intervals, and the shapes found with their 95 % intervals.

    `model` was identified with the shapes of `shape_fit` taken as exact. Its intervals then include
    the uncertainty of the shapes, and errors of the effects' forms (`scatter.with_form_errors`).
    """
    data, fit = shape_fit.data, shape_fit.fit
    shift = form_shift(data, fit)
    shapes: dict[str, Estimate] = {}
    for used in fit.terms:
        if used in data.terms or not isinstance(used.term, Effect):
            continue
        shape_names = {s.parameter for s in shapes_of(data.rig, used)}
        all_estimates = estimates(data, used, effect_errors(data, fit, used), shift)
        shapes |= {name: e for name, e in all_estimates.items() if name in shape_names}
    return with_form_errors(data, fit, model, shift), shapes


def basis_of_others(train_data: RegressionData, model: ExactFit, own: Sequence[str]) -> Array:
    """Return an orthonormal basis (M, r) of a model's tangent without the parameters `own`."""
    names, X = tangent(train_data, model)
    return orthonormal(X[:, [k for k, n in enumerate(names) if n not in own]])
