"""Invariance: whether an effect has the same size in all parts of the records, as a cause has.

The linearised model is solved again on parts of the rows: each step, each half of the records, each
direction of motion, fast and slow. The size may differ by noise, by the error of the catalogue's
simpler form and by the form error of a larger effect, together.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shapes_of
from analysis.terms.base import Used, joint_of
from analysis.trace.data.candidates import effect_in
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.inference import EffectErrors, basis_of_others, flip_blocks
from analysis.trace.search.exact_fit import ExactFit, contribution, design_matrix, jacobian
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import SEARCH, TRACE

Array = NDArray[np.float64]


class Difference(NamedTuple):
    """A part of the rows in which a parameter has another value than in all rows.

    `value` is the value in the part, `error` its standard error, both in the parameter's unit.
    """

    part: str
    parameter: str
    value: float
    error: float


def row_subsets(train_data: RegressionData, joint: int | None) -> dict[str, Array]:
    """Return masks (M,) of the parts of the rows, by name.

    Direction and speed are those of `joint` (0-based), or of each equation's own joint if None.
    """
    M = train_data.base.shape[0]
    out: dict[str, Array] = {}
    early, extending = np.zeros(M, dtype=bool), np.zeros(M, dtype=bool)
    fast = np.zeros(M, dtype=bool)
    for s in train_data.segments:
        name = f"step {s.group[1]}"
        out.setdefault(name, np.zeros(M, dtype=bool))[s.where] = True
        conditioned, rows = train_data.source(s)
        time = rows.time
        early[s.where] = time < 0.5 * (time[0] + time[-1])
        joint_number = joint if joint is not None else joint_of(s.equation)
        speed = conditioned.signals.sd[conditioned.samples_at(time), joint_number]
        extending[s.where] = speed > 0
        size = np.abs(speed)
        fast[s.where] = size > np.median(size)
    out |= {
        "first half": early, "second half": ~early, "extending": extending,
        "retracting": ~extending, "fast": fast, "slow": ~fast,
    }  # fmt: skip
    return out


def _blocks_as_noise(train_data: RegressionData) -> NDArray[np.int64] | None:
    """Return the number of the block of every row (M,), None where the noise was measured.

    Where a step has neither repeats nor periods, the residual of each block counts as noise.
    """
    if all(floor.count > 1 for floor in train_data.floors):
        return None
    numbers = flip_blocks(train_data)
    between = int(numbers.max()) + 1
    for k, s in enumerate(train_data.segments):
        numbers[s.where] += between * k
    return numbers


def _row_parts(
    train_data: RegressionData, base: Array, joint: int | None
) -> Iterator[tuple[str, Array, Array, NDArray[np.int64] | None]]:
    """Yield the parts of the rows: name, mask (M,), basis of `base` in them, `_blocks_as_noise`."""
    numbers = _blocks_as_noise(train_data)
    for label, mask in row_subsets(train_data, joint).items():
        if mask.any():
            blocks = None if numbers is None else numbers[mask]
            yield label, mask, orthonormal(base[mask]), blocks


def _coefficient_shift(
    column: Array, residual: Array, base: Array, blocks: NDArray[np.int64] | None
) -> tuple[float, float]:
    """Return the change of a coefficient in a part of the rows, and its standard error.

    `column` (m,) is its column orthogonal to the others, whose orthonormal basis is `base` (m, r).
    With `blocks` (m,) the error is also computed from the `residual` (m,) as noise, by block.
    """
    size = float(column @ column)
    shift = float(column @ residual) / size
    error = 1.0 / np.sqrt(size)
    if blocks is not None:
        noise = residual - base @ (base.T @ residual) - column * shift
        _, index = np.unique(blocks, return_inverse=True)
        by_block = np.bincount(index, weights=column * noise)
        error = max(error, float(np.linalg.norm(by_block)) / size)
    return shift, float(error)


def _energy_of_larger_effect(
    model: ExactFit, train_data: RegressionData, used: Used, mask: Array
) -> float:
    """Return the energy of the largest other effect in the rows `mask`, 0 if none is larger.

    The error of its form, `SEARCH.form_share` of this energy, may change the coefficient of a
    smaller effect.
    """
    rows = design_matrix(train_data, model.terms)
    energy = {}
    for u in model.terms:
        if isinstance(u.term, Effect):
            places = [rows.names.index(c.parameter) for c in u.term.coefficients(train_data.rig)]
            values = np.array([model.beta.get(rows.names[k], 0.0) for k in places])
            part = rows.matrix[mask][:, places] @ values
            energy[u.term.key] = float(part @ part)
    own_energy = energy.pop(used.term.key, 0.0)
    most = max(energy.values(), default=0.0)
    return most if most > own_energy else 0.0


def _orthogonal_column(columns: Array, k: int) -> Array:
    """Return column k (m,) projected orthogonal to the other columns."""
    others, column = np.delete(columns, k, axis=1), columns[:, k]
    if not others.shape[1]:
        return column
    Q = orthonormal(others)
    return np.asarray(column - Q @ (Q.T @ column))


def invariance(
    train_data: RegressionData, model: ExactFit, used: Used, value: EffectErrors
) -> list[Difference]:
    """Return the parts of the rows in which a size of an effect differs from that of all rows."""
    joint = effect_in(used).joint if used.term.where.startswith("joint") else None
    names, J = jacobian(train_data, model, used)
    base = basis_of_others(train_data, model, names)
    if effect_in(used).free:
        return _whole_effect_differences(train_data, model, used, base, joint)
    shapes = shapes_of(train_data.rig, used)
    units = {c.parameter: c.unit for c in used.term.coefficients(train_data.rig)}
    # Shapes without a neutral value, such as a presliding distance, are no sizes.
    sizes = {*units, *(s.parameter for s in shapes if s.neutral is not None)}
    units |= {s.parameter: s.unit for s in shapes}
    nothing = {s.parameter: s.neutral or 0.0 for s in shapes}
    neutral = np.array([nothing.get(n, 0.0) for n in names])
    out = []
    J_all = J - base @ (base.T @ J)
    column_energy = [float(np.sum(_orthogonal_column(J_all, k) ** 2)) for k in range(len(names))]
    # A number that the effect's other numbers can replace is no size of its own: then the whole
    # effect is judged.
    replaceable = {
        name
        for k, name in enumerate(names)
        if name in sizes
        and column_energy[k] < TRACE.separable_share * float(J_all[:, k] @ J_all[:, k])
    }
    if replaceable:
        out += _whole_effect_differences(train_data, model, used, base, joint)
        sizes -= replaceable
    for label, mask, B, blocks in _row_parts(train_data, base, joint):
        J_part = J[mask] - B @ (B.T @ J[mask])
        for k, name in enumerate(names):
            if name not in sizes:
                continue
            if np.linalg.norm(J_part[:, k]) < 0.1 * np.linalg.norm(J[mask][:, k]):
                continue
            column = _orthogonal_column(J_part, k)
            size = float(column @ column)
            # A part with little information shows the tail of the form, not the size.
            if (
                size < TRACE.informative_share * column_energy[k]
                or size <= 0
                or not np.isfinite(value.value[k])
            ):
                continue
            shift, error = _coefficient_shift(column, model.residual[mask], B, blocks)
            form_error = np.sqrt(
                SEARCH.form_share * _energy_of_larger_effect(model, train_data, used, mask) / size
            )
            # Differences are relative to the largest number of the same unit: of two levels, 2 N
            # and 100 N, the smaller is a detail.
            same_unit = [j for j, n in enumerate(names) if n in sizes and units[n] == units[name]]
            size_scale = float(np.max(np.abs(value.value[same_unit] - neutral[same_unit])))
            if error > TRACE.subset_error * size_scale:
                continue
            if abs(shift) > form_error + TRACE.standard_errors * np.hypot(
                error, TRACE.invariance_tolerance / TRACE.standard_errors * size_scale
            ):
                out.append(Difference(label, name, float(value.value[k]) + shift, error))
    return out


def _whole_effect_differences(
    train_data: RegressionData, model: ExactFit, used: Used, base: Array,
    joint: int | None,
) -> list[Difference]:  # fmt: skip
    """Return the parts in which a whole effect differs, with its size there over that overall.

    Neighbouring values of a curve, and numbers that can replace each other, are uncertain one by
    one; their common contribution to the rows must be the same everywhere.
    """
    whole = contribution(train_data, model, used)
    total_energy = float(np.sum((whole - base @ (base.T @ whole)) ** 2))
    out = []
    for label, mask, B, blocks in _row_parts(train_data, base, joint):
        part = whole[mask] - B @ (B.T @ whole[mask])
        size = float(part @ part)
        if size <= TRACE.informative_share * total_energy or size < 0.01 * float(
            whole[mask] @ whole[mask]
        ):
            continue
        shift, error = _coefficient_shift(part, model.residual[mask], B, blocks)
        if error <= TRACE.subset_error and abs(shift) > TRACE.standard_errors * np.hypot(
            error, TRACE.invariance_tolerance / TRACE.standard_errors
        ):
            out.append(Difference(label, "the whole effect", 1.0 + shift, error))
    return out
