"""One equation's rows of a set of records, ready to be tried against columns of any kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.rows import Rows
from analysis.signals.conditioning import Signals
from analysis.trace.data.conditioned_record import Scene, filtered, prepared
from analysis.trace.data.regression_data import Board
from analysis.trace.search.linear_fit import orthonormal

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """A record's rows of one equation: signals as the model's terms prepare them, and weight."""

    scene: Scene
    rows: Rows
    seen: Signals
    weight: float


@dataclass(frozen=True)
class Side:
    """One set of records' rows of one equation: residual (m,) off the model's `base` (m, r)."""

    parts: tuple[Part, ...]
    rest: Array
    base: Array


def side_of(stage: Board, left: Array, equation: str) -> Side | None:
    """Return the rows of an equation with the residual `left` (M,) of the stage; None: no rows."""
    index = {scene.group: k for k, scene in enumerate(stage.scenes)}
    parts, rest, base = [], [], []
    for s in stage.segments:
        if s.equation != equation:
            continue
        k = index[s.group]
        seen = prepared(stage.rig, stage.terms, stage.scenes[k])
        weight = float(np.sqrt(s.repeats)) / s.noise
        parts.append(Part(stage.scenes[k], stage.rows[k][equation], seen, weight))
        rest.append(left[s.where])
        base.append(stage.base[s.where])
    if not parts:
        return None
    B = orthonormal(np.concatenate(base))
    r = np.concatenate(rest)
    return Side(tuple(parts), r - B @ (B.T @ r), B)


def columns_of(side: Side, made: Sequence[Array]) -> Array:
    """Return columns (m, k) filtered as the rows are, whitened, off the model's own."""
    stack = []
    for part, columns in zip(side.parts, made, strict=True):
        named = {str(k): columns[:, k] for k in range(columns.shape[1])}
        found = filtered(named, part.scene, part.rows)
        stack.append(np.column_stack(list(found.values())) * part.weight)
    D = np.concatenate(stack)
    return np.asarray(D - side.base @ (side.base.T @ D))


def fitted_to(columns: Array, side: Side) -> Array:
    """Return the coefficients (k,) of columns (m, k) that leave least of a side."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / scale, side.rest, rcond=1e-2)[0] / scale)


def judged(fitted: Array, side: Side, judging: Array, other: Side) -> float:
    """Return the share of the energy above noise that columns fitted to a side take of another."""
    curve = fitted_to(fitted, side)
    q = other.rest
    before = float(q @ q) - len(q)
    after = float(np.sum((q - judging @ curve) ** 2)) - len(q)
    return min(1.0, (before - after) / before) if before > 0 else 0.0
