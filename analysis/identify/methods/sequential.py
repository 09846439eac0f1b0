"""Identify step by step, in the two ways that the paper names (its section II.B).

 E1  a parameter is identified at one step only and known in every step after it
 E2  every step identifies what it can by itself, and the steps' values are averaged

A single step may determine only a combination (STEP2: M1 + 2 R12 cos q2). In E1 its rows are then
solved with the next step's; in E2 such parameters are solved from all rows with the averages known.
Neither result is unique: a parameter that several steps determine (b in all of them) has as many
values as steps. All are reported, with their disagreement in units of their own 95 % intervals: max
|v_i - v_j| / sqrt(h_i^2 + h_j^2).

A known parameter moves to the right-hand side: of [X y] the rows become [X_u, y - X_k b_k] =
[X y] T, and the noise moments N of the columns T' N T.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.identify.checks import Check, consistency
from analysis.identify.reduction import (
    RecordReduction,
    clusters_of,
    noise_of,
    record_checks,
    reduce_rows,
)
from analysis.identify.result import Identification, estimates_of
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import Filtering, parameters_of
from analysis.regression.solve import RowCluster, Solution, half_width, merge, solve, square
from analysis.simulation.model import Estimate, Model, estimate_json, finite
from analysis.terms.base import FAMILIES, Used
from rig.model.parse import InputError
from rig.model.records import Record, Run

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepValue:
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

    name: str
    clusters: Sequence[RowCluster]
    noise: Array


@dataclass(frozen=True)
class StepwiseFit:
    """One family solved step by step: each step's values (`alone`) and condition number, E1, E2.

    E1 is `first`, E2 `averaged`. `rows` counts the rows of all steps, `triangle` (k+1, k+1)
    represents them; `lost` states, by parameter, why E1 has no value.
    """

    names: tuple[str, ...]
    alone: Mapping[str, Sequence[StepValue]]
    first: Mapping[str, StepValue]
    averaged: Mapping[str, StepValue]
    condition: Mapping[str, float]
    rows: int
    triangle: Array
    lost: Mapping[str, str]

    def solution(self, values: Mapping[str, StepValue]) -> Solution:
        """Return `values` as a solution, with their residual over all rows; the others are NaN."""
        k, R = len(self.names), self.triangle
        value, std, dof = (np.full(k, np.nan) for _ in range(3))
        for i, name in enumerate(self.names):
            if name in values:
                estimate = values[name]
                value[i], std[i], dof[i] = estimate.value, estimate.std, estimate.dof
        residual = R[:k, k] - R[:k, :k] @ np.nan_to_num(value)
        squares = float(np.sum(residual**2)) + float(R[k, k] ** 2)
        reasons = {
            name: self.lost.get(name, "no step determines it")
            for name in self.names
            if name not in values
        }
        return Solution(
            self.names, value, np.diag(std**2), dof, max(self.condition.values()), self.rows,
            float(np.sqrt(squares / max(self.rows, 1))), np.full(k, np.nan), reasons,
        )  # fmt: skip


def sequential(
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    reject_noise: bool,
) -> Identification:
    """Identify step by step: the estimates are E1's, `extra` holds E2 and every step's values.

    Raises InputError for runs of different rigs and records that cannot be used.
    """
    rig = ck.common_rig(runs)
    built = build_rows(rig, runs, terms, filtering)
    reductions = reduce_rows(rig, terms, built)
    names = {family: parameters_of(rig, terms, family) for family in FAMILIES}
    steps = {family: _steps(reductions, family, len(names[family])) for family in FAMILIES}
    masked = sum(reduction.masked for reduction in reductions)
    started = time.perf_counter()
    outcomes = {f: _solved_by_steps(names[f], steps[f], reject_noise) for f in FAMILIES}
    seconds = time.perf_counter() - started
    solutions = {f: o.solution(o.first) for f, o in outcomes.items()}
    estimates, covariance = estimates_of(rig, terms, solutions)
    rows = {family: outcome.rows for family, outcome in outcomes.items()}
    # Every step's own values, as estimates in the parameter's unit.
    by_name = {
        name: {
            value.step: estimates_of(rig, terms, {f: o.solution({name: value})})[0][name]
            for value in values
        }
        for f, o in outcomes.items()
        for name, values in o.alone.items()
    }
    statements = (
        _uniqueness(by_name),
        *record_checks(rig, reductions, rows),
        *consistency(rig, estimates),
    )
    provenance = {
        "method": "sequential",
        "runs": [run.source for run in runs],
        "records": [reduction.head.name for reduction in reductions],
        "rows": rows,
    }
    second = {f: o.solution(o.averaged) for f, o in outcomes.items()}
    extra = {"sequential": _json(outcomes, by_name, estimates, estimates_of(rig, terms, second)[0])}
    model = Model(rig, tuple(terms), estimates, covariance, provenance)
    result = Identification(model, solutions, masked, seconds, extra=extra, built=tuple(built))
    return result.with_checks(statements)


def _steps(reductions: Sequence[RecordReduction], family: str, columns: int) -> list[StepRows]:
    """Return the steps that have rows of a family with `columns` coefficients."""
    out = []
    for step in dict.fromkeys(reduction.head.step for reduction in reductions):
        part = [reduction for reduction in reductions if reduction.head.step == step]
        clusters, noise = clusters_of(part, family), noise_of(part, family)
        if clusters:
            noise = np.zeros((columns + 1, columns + 1)) if noise is None else noise
            out.append(StepRows(step, clusters, noise))
    if not out:
        raise InputError(f"every {family} row of the records is masked; take other records")
    return out


def disagreement(by_step: Mapping[str, Estimate]) -> float:
    """Return the largest difference of two steps' values over their common 95 % half width."""
    return max(
        (
            abs(a.value - b.value) / float(np.hypot(a.half, b.half))
            for a, b in itertools.combinations(by_step.values(), 2)
        ),
        default=0.0,
    )


def _uniqueness(by_name: Mapping[str, Mapping[str, Estimate]]) -> Check:
    """State which parameters have several values, and by how much the worst of them disagree."""
    gaps = {n: disagreement(by_step) for n, by_step in by_name.items() if len(by_step) > 1}
    if not gaps:
        return Check("one value each", True, "no parameter is identified by more than one step")
    texts = []
    for name in sorted(gaps, key=lambda n: -gaps[n])[: IDENTIFY.worst_shown]:
        values = ", ".join(f"{step} {e.value:.5g}" for step, e in by_name[name].items())
        texts.append(f"{name}: {values} ({gaps[name]:.1f} of their 95 % intervals apart)")
    return Check(
        "one value each", False,
        f"{len(gaps)} parameters have several values, worst: " + "; ".join(texts),
    )  # fmt: skip


def _json(
    outcomes: Mapping[str, StepwiseFit],
    by_name: Mapping[str, Mapping[str, Estimate]],
    first: Mapping[str, Estimate],
    averaged: Mapping[str, Estimate],
) -> dict[str, Any]:
    first_steps = {n: v.step for o in outcomes.values() for n, v in o.first.items()}
    average_steps = {n: v.step for o in outcomes.values() for n, v in o.averaged.items()}
    return {
        "steps": list(next(iter(outcomes.values())).condition),
        "per_step": {
            name: [{"step": step, **estimate_json(e)} for step, e in by_step.items()]
            for name, by_step in by_name.items()
        },
        "disagreement": {
            name: finite(disagreement(by_step))
            for name, by_step in by_name.items()
            if len(by_step) > 1
        },
        "E1": {n: {"step": first_steps.get(n), **estimate_json(e)} for n, e in first.items()},
        "E2": {n: {"steps": average_steps.get(n), **estimate_json(e)} for n, e in averaged.items()},
        "condition_number": {
            family: {step: finite(c) for step, c in outcome.condition.items()}
            for family, outcome in outcomes.items()
        },
    }


def _solved_by_steps(
    names: tuple[str, ...], steps: Sequence[StepRows], reject_noise: bool
) -> StepwiseFit:
    """Solve one family step by step: each step alone, E1 and E2."""
    step_values: dict[str, list[StepValue]] = {name: [] for name in names}
    condition = {}
    for step in steps:
        step_solution = solve(names, step.clusters, step.noise, reject_noise)
        condition[step.name] = step_solution.condition_number
        for name, value in _values(step.name, step_solution).items():
            if value.precise:
                step_values[name].append(value)
    first, lost = _solve_in_turn(names, steps, reject_noise)
    averaged = _average(names, steps, step_values, reject_noise)
    return StepwiseFit(
        names, step_values, first, averaged, condition,
        sum(c.rows for s in steps for c in s.clusters),
        merge(c.triangle for s in steps for c in s.clusters), lost,
    )  # fmt: skip


def _values(step: str, solution: Solution) -> dict[str, StepValue]:
    std = np.sqrt(np.diag(solution.covariance))
    return {
        name: StepValue(step, float(v), float(s), float(d))
        for name, v, s, d in zip(solution.names, solution.value, std, solution.dof, strict=True)
        if np.isfinite(v)
    }


def _solve_in_turn(
    names: tuple[str, ...], steps: Sequence[StepRows], reject_noise: bool
) -> tuple[dict[str, StepValue], dict[str, str]]:
    """Solve each step with the parameters of the steps before it known (E1)."""
    known: dict[str, StepValue] = {}
    lost: dict[str, str] = {}
    pending: list[StepRows] = []
    for index, step in enumerate(steps):
        pending.append(step)
        if len(known) == len(names):
            break
        solution = _solve_unknown(names, pending, known, reject_noise)
        last = index == len(steps) - 1
        for name, value in _values(step.name, solution).items():
            if value.precise or last:
                known[name] = value
        lost = solution.unidentifiable
        pending = [s for s in pending if _has_unknown(names, s, known)]
    return known, {name: why for name, why in lost.items() if name not in known}


def _has_unknown(names: tuple[str, ...], step: StepRows, known: Mapping[str, StepValue]) -> bool:
    """Return whether a step's rows contain any parameter that is still unknown."""
    columns = [i for i, name in enumerate(names) if name not in known]
    return any(np.any(c.triangle[:, columns] != 0.0) for c in step.clusters)


def _average(
    names: tuple[str, ...],
    steps: Sequence[StepRows],
    step_values: Mapping[str, Sequence[StepValue]],
    reject_noise: bool,
) -> dict[str, StepValue]:
    """Average the steps' own values and solve the others from all rows (E2)."""
    known = {}
    for name, values in step_values.items():
        if values:
            n = len(values)
            std = float(np.sqrt(sum(v.std**2 for v in values))) / n
            averaged = " ".join(v.step for v in values)
            mean = float(np.mean([v.value for v in values]))
            known[name] = StepValue(averaged, mean, std, float(sum(v.dof for v in values)))
    if len(known) == len(names):
        return known
    rest = _values("all", _solve_unknown(names, steps, known, reject_noise))
    return {name: known.get(name) or rest[name] for name in names if name in known or name in rest}


def _solve_unknown(
    names: tuple[str, ...],
    steps: Sequence[StepRows],
    known: Mapping[str, StepValue],
    reject_noise: bool,
) -> Solution:
    """Solve the steps' rows for the unknown parameters; known values count as exact."""
    k = len(names)
    free = [i for i, name in enumerate(names) if name not in known]
    T = np.zeros((k + 1, len(free) + 1))
    T[free, range(len(free))] = 1.0
    T[:k, -1] = [-known[name].value if name in known else 0.0 for name in names]
    T[k, -1] = 1.0
    clusters = [
        replace(c, triangle=square(c.triangle @ T)) for step in steps for c in step.clusters
    ]
    noise = sum((T.T @ s.noise @ T for s in steps), np.zeros((len(free) + 1,) * 2))
    return solve([names[i] for i in free], clusters, noise, reject_noise)
