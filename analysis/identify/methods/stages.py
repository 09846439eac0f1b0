"""One family of rows solved step by step, in the paper's two ways (E1 and E2).

A known parameter moves to the right-hand side: of [X y] the rows become [X_u, y - X_k b_k] =
[X y] T, and the noise moments N of the columns T' N T.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import RowCluster, Solution, half_width, merge, solve, triangle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StageValue:
    """One value of one coefficient: the step it came from, standard error, degrees of freedom."""

    step: str
    value: float
    std: float
    dof: float

    @property
    def half(self) -> float:
        """Half width of the 95 % interval."""
        return float(half_width(np.array(self.std), np.array(self.dof)))

    @property
    def precise(self) -> bool:
        """Whether the interval is narrow enough for the value to be used."""
        return bool(
            np.isfinite(self.value) and self.half < IDENTIFY.stage_precision * abs(self.value)
        )


@dataclass(frozen=True)
class StepRows:
    """One family's rows of one step, reduced, with the noise moments of its columns."""

    step: str
    clusters: tuple[RowCluster, ...]
    noise: Array


@dataclass(frozen=True)
class StageOutcome:
    """One family solved step by step: every step's own values, E1's, E2's, and conditioning."""

    names: tuple[str, ...]
    own: Mapping[str, tuple[StageValue, ...]]
    first: Mapping[str, StageValue]
    averaged: Mapping[str, StageValue]
    condition: Mapping[str, float]
    rows: int
    all_rows: Array
    lost: Mapping[str, str] = field(default_factory=dict)


def solve_stages(
    names: tuple[str, ...], stages: Sequence[StepRows], reject_noise: bool
) -> StageOutcome:
    """Solve one family step by step in both ways."""
    own: dict[str, list[StageValue]] = {name: [] for name in names}
    condition = {}
    for stage in stages:
        alone = solve(names, stage.clusters, stage.noise, reject_noise)
        condition[stage.step] = alone.condition_number
        for name, value in _values(stage.step, alone).items():
            if value.precise:
                own[name].append(value)
    first, lost = _use_first(names, stages, reject_noise)
    averaged = _average(names, stages, own, reject_noise)
    return StageOutcome(
        names, {n: tuple(v) for n, v in own.items()}, first, averaged, condition,
        sum(c.rows for s in stages for c in s.clusters),
        merge(c.triangle for s in stages for c in s.clusters), lost,
    )  # fmt: skip


def _values(step: str, solution: Solution) -> dict[str, StageValue]:
    std = np.sqrt(np.diag(solution.covariance))
    return {
        name: StageValue(step, float(v), float(s), float(d))
        for name, v, s, d in zip(solution.names, solution.value, std, solution.dof, strict=True)
        if np.isfinite(v)
    }


def _use_first(
    names: tuple[str, ...], stages: Sequence[StepRows], reject_noise: bool
) -> tuple[dict[str, StageValue], dict[str, str]]:
    """E1: solve each step with the parameters of the steps before it known."""
    known: dict[str, StageValue] = {}
    lost: dict[str, str] = {}
    waiting: list[StepRows] = []
    for place, stage in enumerate(stages):
        waiting.append(stage)
        unknown = tuple(name for name in names if name not in known)
        if not unknown:
            break
        solution = _solve_unknown(names, waiting, known, reject_noise)
        last = place == len(stages) - 1
        for name, value in _values(stage.step, solution).items():
            if value.precise or last:
                known[name] = value
        lost = solution.unidentifiable
        waiting = [s for s in waiting if _has_unknown(names, s, known)]
    return known, {name: why for name, why in lost.items() if name not in known}


def _has_unknown(names: tuple[str, ...], stage: StepRows, known: Mapping[str, StageValue]) -> bool:
    """Return whether a stage's rows contain any parameter that is still unknown."""
    columns = [i for i, name in enumerate(names) if name not in known]
    return any(np.any(c.triangle[:, columns] != 0.0) for c in stage.clusters)


def _average(
    names: tuple[str, ...],
    stages: Sequence[StepRows],
    own: Mapping[str, Sequence[StageValue]],
    reject_noise: bool,
) -> dict[str, StageValue]:
    """E2: average the steps' own values; solve the others from all rows."""
    known = {}
    for name, values in own.items():
        if values:
            n = len(values)
            std = float(np.sqrt(sum(v.std**2 for v in values))) / n
            steps = " ".join(v.step for v in values)
            mean = float(np.mean([v.value for v in values]))
            known[name] = StageValue(steps, mean, std, float(sum(v.dof for v in values)))
    if len(known) == len(names):
        return known
    rest = _values("all", _solve_unknown(names, stages, known, reject_noise))
    return {name: known.get(name) or rest[name] for name in names if name in known or name in rest}


def _solve_unknown(
    names: tuple[str, ...],
    stages: Sequence[StepRows],
    known: Mapping[str, StageValue],
    reject_noise: bool,
) -> Solution:
    """Solve the stages' rows for the unknown parameters; known values count as exact."""
    k = len(names)
    free = [i for i, name in enumerate(names) if name not in known]
    T = np.zeros((k + 1, len(free) + 1))
    T[free, range(len(free))] = 1.0
    T[:k, -1] = [-known[name].value if name in known else 0.0 for name in names]
    T[k, -1] = 1.0
    clusters = [
        replace(c, triangle=triangle(rows[:, :-1], rows[:, -1]))
        for s in stages for c in s.clusters for rows in (c.triangle @ T,)
    ]  # fmt: skip
    noise = sum((T.T @ s.noise @ T for s in stages), np.zeros((len(free) + 1,) * 2))
    return solve([names[i] for i in free], clusters, noise, reject_noise)


def as_solution(outcome: StageOutcome, values: Mapping[str, StageValue]) -> Solution:
    """Return a list of values as a solution, with its residual over all rows."""
    k = len(outcome.names)
    value, std, dof = (np.full(k, np.nan) for _ in range(3))
    for i, name in enumerate(outcome.names):
        if name in values:
            estimate = values[name]
            value[i], std[i], dof[i] = estimate.value, estimate.std, estimate.dof
    R = outcome.all_rows
    there = np.nan_to_num(value)
    squares = float(np.sum((R[:k, k] - R[:k, :k] @ there) ** 2)) + float(R[k, k] ** 2)
    lost = {
        name: outcome.lost.get(name, "no step determines it")
        for name in outcome.names
        if name not in values
    }
    return Solution(
        outcome.names, value, np.diag(std**2), dof, max(outcome.condition.values()), outcome.rows,
        float(np.sqrt(squares / max(outcome.rows, 1))), np.full(k, np.nan), lost,
    )  # fmt: skip
