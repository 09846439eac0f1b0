"""Clues: what an unexplained residual moves with. A clue is not a name.

For each variable v the residual's equation gets a free curve of v (hat functions over quantiles,
filtered like any column, projected off the model's own columns) on one set of records, and is
judged on the other: the share of the energy above noise that the curve takes from records it was
not fitted to. Friedman's partial dependence, with the held-out record as its referee.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.rows import Rows
from analysis.signals import Signals
from analysis.trace.board import Board
from analysis.trace.evidence import Scene, filtered, prepared
from analysis.trace.result import Dependence
from analysis.trace.select import orthonormal
from rig.model import channels as ch

Array = NDArray[np.float64]

KNOTS = 9
ANSWER = 0.6  # weight of a variable that only answers
LEAST = 0.05  # share below which a variable is no clue
BENCH = (ch.SUPPLY, ch.TEMPERATURE, "time")


def variables(signals: Signals, joint: int) -> dict[str, Array]:
    """Return the variables (n,) that a residual of a joint (0-based) may move with, by name."""
    i, cap, rod = joint, signals.p_cap[:, joint], signals.p_rod[:, joint]
    return {
        ch.channel(ch.PISTON, i + 1): signals.s[:, i],
        f"velocity_{i + 1}": signals.sd[:, i],
        f"acceleration_{i + 1}": np.gradient(signals.sd[:, i]) * signals.rate,
        ch.channel(ch.CAP, i + 1): cap,
        ch.channel(ch.ROD, i + 1): rod,
        f"pressure_difference_{i + 1}": cap - rod,
        ch.channel(ch.SPOOL, i + 1): signals.u[:, i],
        ch.SUPPLY: signals.p_s,
        ch.TEMPERATURE: signals.temperature,
        "time": signals.t,
    }


def hats(v: Array, knots: Array) -> Array:
    """Return the hat functions (n, k) of a piecewise linear curve with the given knots."""
    out = np.zeros((len(v), len(knots)))
    place = np.clip(np.searchsorted(knots, v) - 1, 0, len(knots) - 2)
    share = np.clip((v - knots[place]) / (knots[place + 1] - knots[place]), 0.0, 1.0)
    at = np.arange(len(v))
    out[at, place] = 1.0 - share
    out[at, place + 1] = share
    return out


def dependence(
    train: Board, left: Array, judge: Board, judge_left: Array, equations: Sequence[str]
) -> list[Dependence]:
    """Return the variables by what share of the energy above noise they carry, largest first.

    `left` (M,) and `judge_left` are residuals under the model of `train` (rebased to it).
    """
    best: dict[str, Dependence] = {}
    weight = {e: _energy(train, left, e) for e in equations}
    total = sum(weight.values()) or 1.0
    shares: dict[str, float] = {}
    for equation in equations:
        joint = int(equation.rsplit("_", 1)[1]) - 1
        for name in variables(train.scenes[0].signals, joint):
            found = _share(train, left, judge, judge_left, equation, joint, name)
            shares[name] = shares.get(name, 0.0) + found * weight[equation] / total
            if name not in best or found > best[name].share:
                best[name] = Dependence(name, found, equation)
    out = [
        Dependence(name, share, best[name].equation)
        for name, share in shares.items()
        if share >= LEAST
    ]
    return sorted(out, key=lambda d: -d.share * (ANSWER if _answers(d) else 1.0))


def _answers(found: Dependence) -> bool:
    """Tell whether a variable answers its equation: pressures balance any torque that acts."""
    return found.equation.startswith("torque") and "pressure" in found.variable


def _energy(stage: Board, left: Array, equation: str) -> float:
    found = 0.0
    for s in stage.segments:
        if s.equation == equation:
            found += float(left[s.where] @ left[s.where]) - (s.where.stop - s.where.start)
    return max(found, 0.0)


def _share(
    train: Board, left: Array, judge: Board, judge_left: Array, equation: str, joint: int, name: str
) -> float:
    """Fit a curve on each set of records and judge it on the other; the larger share, >= 0.

    A curve fitted to small motions says nothing of large ones; the other way round it does.
    """
    values = [
        variables(scene.signals, joint)[name]
        for stage in (train, judge)
        for scene in stage.scenes
        if joint + 1 not in scene.record.locked
    ]
    if not values:
        return 0.0
    everything = np.concatenate(values)
    knots = np.unique(np.quantile(everything, np.linspace(0.005, 0.995, KNOTS)))
    if len(knots) < 3 or np.ptp(knots) <= 1e-9 * max(1e-300, float(np.max(np.abs(knots)))):
        return 0.0
    first = _projected(train, left, equation, joint, name, knots)
    second = _projected(judge, judge_left, equation, joint, name, knots)
    if first is None or second is None:
        return 0.0
    return max(0.0, _judged(first, second), _judged(second, first))


def _judged(fitted: tuple[Array, Array], on: tuple[Array, Array]) -> float:
    D, r = fitted
    scale = np.linalg.norm(D, axis=0)
    scale[scale == 0] = 1.0
    curve = np.linalg.lstsq(D / scale, r, rcond=1e-2)[0] / scale
    E, q = on
    before = float(q @ q) - len(q)
    after = float(np.sum((q - E @ curve) ** 2)) - len(q)
    return (before - after) / before if before > 0 else 0.0


def _projected(
    stage: Board, left: Array, equation: str, joint: int, name: str, knots: Array
) -> tuple[Array, Array] | None:
    """Return the curve's columns and the residual on one equation's rows, off the model's own."""
    columns, rest, base = [], [], []
    index = {scene.group: k for k, scene in enumerate(stage.scenes)}
    for s in stage.segments:
        if s.equation != equation:
            continue
        scene: Scene = stage.scenes[index[s.group]]
        rows: Rows = stage.rows[index[s.group]][equation]
        seen = prepared(stage.rig, stage.terms, scene)
        curve = hats(variables(seen, joint)[name], knots)
        found = filtered({str(k): curve[:, k] for k in range(curve.shape[1])}, scene, rows)
        stack = np.column_stack(list(found.values())) * np.sqrt(s.repeats) / s.noise
        columns.append(stack)
        rest.append(left[s.where])
        base.append(stage.base[s.where])
    if not columns:
        return None
    D, r, B = np.concatenate(columns), np.concatenate(rest), orthonormal(np.concatenate(base))
    return D - B @ (B.T @ D), r - B @ (B.T @ r)


def curve_of(
    stage: Board, left: Array, equation: str, name: str, count: int = 24
) -> Mapping[str, Array]:
    """Return the residual of an equation binned over a variable: `x`, `mean`, `low`, `high`."""
    joint = int(equation.rsplit("_", 1)[1]) - 1
    x, y = [], []
    index = {scene.group: k for k, scene in enumerate(stage.scenes)}
    for s in stage.segments:
        if s.equation == equation:
            scene = stage.scenes[index[s.group]]
            rows = stage.rows[index[s.group]][equation]
            found = filtered({name: variables(scene.signals, joint)[name]}, scene, rows)
            x.append(found[name])
            y.append(left[s.where] * s.noise / np.sqrt(s.repeats))
    if not x:
        return {k: np.zeros(0) for k in ("x", "mean", "low", "high")}
    return binned(np.concatenate(x), np.concatenate(y), count)


def binned(x: Array, y: Array, count: int = 24) -> dict[str, Array]:
    """Return mean and quartiles of y in bins of equally many x."""
    order = np.argsort(x)
    parts = [p for p in np.array_split(order, min(count, max(1, len(x) // 5))) if len(p)]
    return {
        "x": np.array([x[p].mean() for p in parts]),
        "mean": np.array([y[p].mean() for p in parts]),
        "low": np.array([np.quantile(y[p], 0.25) for p in parts]),
        "high": np.array([np.quantile(y[p], 0.75) for p in parts]),
    }
