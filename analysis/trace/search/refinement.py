"""Refinement: a set of effects fitted exactly, shapes by variable projection.

The rows of the averaged records are rebuilt at every shape, linear coefficients are solved for,
and only the shapes are searched (Golub and Pereyra, 1973). An effect that rescales the right side
(a sensor's gain) must not win by making everything small: rows are scaled back to the right
side's size before the change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares as search_shapes

from analysis.effects.base import Effect, Shape, shapes_of
from analysis.regression.rows import Rows
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import Scene, acts_on, held, scene_rows
from analysis.trace.data.regression_data import Board
from analysis.trace.search.linear_fit import CHANCE, orthonormal
from rig.model.rig import Rig

Array = NDArray[np.float64]

TOLERANCE = 1e-4
MOST_STEPS = 10
DETAIL = 0.05  # of what is left above noise: less does not earn a detail of the form
REMEMBERED = 300  # families of rows of scenes under a model, about 0.1 MB each


@dataclass(frozen=True)
class Table:
    """Whitened rows of a model on a board: matrix (M, k) of `names`, right side (M,)."""

    names: tuple[str, ...]
    matrix: Array
    rhs: Array

    def left(self, beta: Mapping[str, float]) -> Array:
        """Return the residual (M,) under coefficients of the rows."""
        return np.asarray(self.rhs - self.matrix @ np.array([beta.get(n, 0.0) for n in self.names]))


@dataclass(frozen=True)
class Fit:
    """A model with shapes found: terms, the rows' coefficients, residual (M,) on the board."""

    terms: tuple[Used, ...]
    beta: Mapping[str, float]
    left: Array

    @property
    def energy(self) -> float:
        """Whitened energy of the residual."""
        return float(self.left @ self.left)


def table(stage: Board, terms: Sequence[Used]) -> Table:
    """Return the whitened rows of a model on the stage's averaged records and instants.

    Instants that the model masks become zero rows.
    """
    built = [_rows(stage, terms, scene) for scene in stage.scenes]
    names = tuple(dict.fromkeys(c.parameter for u in terms for c in u.term.coefficients(stage.rig)))
    M = stage.base.shape[0]
    X, y = np.zeros((M, len(names))), np.zeros(M)
    index = {scene.group: k for k, scene in enumerate(stage.scenes)}
    for segment in stage.segments:
        k = index[segment.group]
        rows, before = built[k][segment.equation], stage.rows[k][segment.equation]
        _, here, there = np.intersect1d(before.time, rows.time, return_indices=True)
        size = np.linalg.norm(before.rhs[here]) / max(
            float(np.linalg.norm(rows.rhs[there])), 1e-300
        )
        weight = np.sqrt(segment.repeats) / segment.noise * size
        at = segment.where.start + here
        columns = [names.index(n) for n in rows.names]
        X[np.ix_(at, columns)] = rows.matrix[there] * weight
        y[at] = rows.rhs[there] * weight
    return Table(names, X, y)


def _rows(stage: Board, terms: Sequence[Used], scene: Scene) -> dict[str, Rows]:
    """Return a scene's rows, remembered: many sets share what acts on a family of its rows."""
    here = [u for u in terms if not held(u.term, scene)]
    found: dict[str, Rows] = {}
    for family in scene.families:
        acting = tuple(u for u in here if acts_on(stage.rig, u.term, family))
        key = (scene.group, family, acting)
        if key not in stage.memo:
            if len(stage.memo) >= REMEMBERED:
                stage.memo.clear()
            stage.memo[key] = scene_rows(stage.rig, acting, replace(scene, families=(family,)))
        found |= stage.memo[key]
    return found


def fit(stage: Board, terms: Sequence[Used]) -> Fit:
    """Solve a model's coefficients on the board, shapes as they are."""
    rows = table(stage, terms)
    scale = np.linalg.norm(rows.matrix, axis=0)
    scale[scale == 0] = 1.0
    value = np.linalg.lstsq(rows.matrix / scale, rows.rhs, rcond=1e-6)[0] / scale
    beta = dict(zip(rows.names, value, strict=True))
    return Fit(tuple(terms), beta, rows.left(beta))


def refine(stage: Board, terms: Sequence[Used], steps: int = MOST_STEPS) -> Fit:
    """Search the shape parameters that the board's own terms do not have, from where they are.

    Then details of forms join, one after another, that take more away than chance, and a share of
    what is left.
    """
    found = _searched(stage, terms, steps)
    for k in range(len(terms)):
        used = found.terms[k]
        opened = used if used in stage.terms else _in_detail(stage.rig, used)
        asked = max(CHANCE, DETAIL * (found.energy - len(found.left)))
        # Half, since in a straight line a detail promises less than it takes.
        if opened == used or _promise(stage, found, used, opened) < 0.5 * asked:
            continue
        more = _searched(stage, _with(found.terms, used, opened), steps)
        found = more if found.energy - more.energy > asked else found
    return found


def _promise(stage: Board, found: Fit, used: Used, opened: Used) -> float:
    """Return the energy that a term with its details would take, were all linear in them."""
    column = table(stage, _with(found.terms, used, opened)).left(found.beta) - found.left
    absorbed = np.hstack((table(stage, found.terms).matrix, jacobian(stage, found, used)[1]))
    basis = orthonormal(absorbed)
    column = column - basis @ (basis.T @ column)
    size = float(column @ column)
    return float(column @ found.left) ** 2 / size if size > 0 else 0.0


def _with(terms: Sequence[Used], used: Used, other: Used) -> tuple[Used, ...]:
    """Return the terms with another in the place of one."""
    return tuple(other if u is used else u for u in terms)


def _in_detail(rig: Rig, used: Used) -> Used:
    """Return a term with the details that its shape does without, at their first look."""
    if not isinstance(used.term, Effect) or not len(used.shape):
        return used
    more = [s.middle for s in used.term.shapes(rig)[len(used.shape) :]]
    return Used(used.term, (*used.shape, *more))


def _searched(stage: Board, terms: Sequence[Used], steps: int) -> Fit:
    free = _free(stage, terms)
    if not free:
        return fit(stage, terms)
    terms = _on_the_right_side(stage, terms, free)
    start = np.array([_to_unit(terms[k].shape[j], s) for k, j, s in free])

    def at(x: Array) -> tuple[Used, ...]:
        shapes = [list(u.shape) for u in terms]
        for value, (k, j, s) in zip(x, free, strict=True):
            shapes[k][j] = _from_unit(float(value), s)
        return tuple(Used(u.term, tuple(v)) for u, v in zip(terms, shapes, strict=True))

    found = search_shapes(
        lambda x: fit(stage, at(x)).left, np.clip(start, 1e-6, 1 - 1e-6), bounds=(0.0, 1.0),
        diff_step=1e-3, xtol=TOLERANCE, ftol=TOLERANCE, gtol=1e-12,
        max_nfev=steps,
    )  # fmt: skip
    return fit(stage, at(found.x))


def _free(stage: Board, terms: Sequence[Used]) -> list[tuple[int, int, Shape]]:
    """Return the shapes to be searched: place of the term, of the shape in it, and what it is."""
    return [
        (k, j, s)
        for k, u in enumerate(terms)
        if u not in stage.terms
        for j, s in enumerate(shapes_of(stage.rig, u))
    ]


def _on_the_right_side(
    stage: Board, terms: Sequence[Used], free: Sequence[tuple[int, int, Shape]]
) -> tuple[Used, ...]:
    """Return the terms with every free shape on the side of its neutral value that leaves less.

    Of a column the first look tells the size, not the sign; and from the wrong side a search runs
    away to the bound, not through the neutral value.
    """
    terms, least = tuple(terms), np.nan
    for k, j, s in free:
        if s.neutral is None or not s.low < s.neutral < s.high:
            continue
        used = terms[k]
        mirrored = float(np.clip(2 * s.neutral - used.shape[j], s.low, s.high))
        shape = (*used.shape[:j], mirrored, *used.shape[j + 1 :])
        other = (*terms[:k], Used(used.term, shape), *terms[k + 1 :])
        if np.isnan(least):  # few effects lie on either side of nothing
            least = fit(stage, terms).energy
        energy = fit(stage, other).energy
        if energy < least:
            terms, least = other, energy
    return terms


def _logarithmic(shape: Shape) -> bool:
    return shape.low > 0 and shape.high / shape.low > 20


def _to_unit(value: float, shape: Shape) -> float:
    """Map a shape parameter to 0..1 between its bounds, by its logarithm where these lie far."""
    if _logarithmic(shape):
        return float(np.log(value / shape.low) / np.log(shape.high / shape.low))
    return (value - shape.low) / (shape.high - shape.low)


def _from_unit(x: float, shape: Shape) -> float:
    if _logarithmic(shape):
        return float(shape.low * (shape.high / shape.low) ** x)
    return shape.low + x * (shape.high - shape.low)


def jacobian(stage: Board, model: Fit, used: Used) -> tuple[tuple[str, ...], Array]:
    """Return names and whitened columns (M, p) of an effect's coefficients and shapes.

    A column is what a unit more of the parameter adds to the model's side of the rows.
    """
    rows = table(stage, model.terms)
    own = [c.parameter for c in used.term.coefficients(stage.rig)]
    names, columns = list(own), [rows.matrix[:, rows.names.index(n)] for n in own]
    for j, shape in enumerate(shapes_of(stage.rig, used)):
        step = 1e-3 * (shape.high - shape.low)
        if _logarithmic(shape):
            step = 1e-2 * used.shape[j]
        up = min(used.shape[j] + step, shape.high)
        down = max(used.shape[j] - step, shape.low)
        ends = []
        for value in (up, down):
            changed = Used(used.term, (*used.shape[:j], value, *used.shape[j + 1 :]))
            ends.append(table(stage, _with(model.terms, used, changed)).left(model.beta))
        names.append(shape.parameter)
        columns.append(-(ends[0] - ends[1]) / (up - down))
    stack = np.column_stack(columns) if columns else np.zeros((len(model.left), 0))
    return tuple(names), stack


def rebased(stage: Board, model: Fit) -> Board:
    """Return the stage with a fitted model in place of its own."""
    rows = table(stage, model.terms)
    built = []
    for scene, before in zip(stage.scenes, stage.rows, strict=True):
        now = scene_rows(stage.rig, model.terms, scene)
        kept = {}
        for equation, old in before.items():
            _, here, there = np.intersect1d(old.time, now[equation].time, return_indices=True)
            matrix = np.zeros((len(old.rhs), len(now[equation].names)))
            rhs = np.zeros(len(old.rhs))
            matrix[here], rhs[here] = now[equation].matrix[there], now[equation].rhs[there]
            kept[equation] = replace(now[equation], matrix=matrix, rhs=rhs, time=old.time)
        built.append(kept)
    return replace(
        stage, terms=model.terms, beta=dict(model.beta), names=rows.names, base=rows.matrix,
        rows=tuple(built),
    )  # fmt: skip
