"""The sequential method, step after step, in the two ways the paper names (its section II.B).

 E1  a parameter is identified at one step only and known in every step after it
 E2  every step identifies what it can by itself, and the steps' values are averaged

A single step may determine only a combination (STEP2: M1 + 2 R12 cos q2). In E1 its rows are then
solved with the next step's; in E2 such parameters are solved from all rows with the averages known.
Neither result is unique: a parameter that several steps determine (b in all of them) has as many
values as steps. All are reported, with their disagreement in units of their own 95 % intervals: max
|v_i - v_j| / sqrt(h_i^2 + h_j^2).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from analysis.identify import checks as ck
from analysis.identify.checks import Check, consistency
from analysis.identify.methods.stages import StageOutcome, StepRows, as_solution, solve_stages
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
from analysis.simulation.model import Estimate, Model, estimate_json, finite
from analysis.terms.base import FAMILIES, Used
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig


def sequential(
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    reject_noise: bool,
) -> Identification:
    """Identify step after step: the estimates are E1's, `extra` holds E2 and every step's values.

    Raises InputError for runs of different rigs and records that cannot be used.
    """
    rig = ck.common_rig(runs)
    built = build_rows(rig, runs, terms, filtering)
    reductions = reduce_rows(rig, terms, built)
    stages = _stages(rig, terms, reductions)
    masked = sum(reduction.masked for reduction in reductions)
    started = time.perf_counter()
    outcomes = {
        family: solve_stages(parameters_of(rig, terms, family), stages[family], reject_noise)
        for family in FAMILIES
    }
    seconds = time.perf_counter() - started
    solutions = {f: as_solution(o, o.first) for f, o in outcomes.items()}
    estimates, covariance = estimates_of(rig, terms, solutions)
    rows = {family: outcome.rows for family, outcome in outcomes.items()}
    shown = {name: _shown(rig, terms, outcomes, name) for name in estimates}
    heads = [reduction.head for reduction in reductions]
    statements = (
        _uniqueness(shown),
        *record_checks(rig, reductions, rows),
        *consistency(rig, estimates),
    )
    provenance = {
        "method": "sequential",
        "runs": [run.source for run in runs],
        "records": [head.name for head in heads],
        "rows": rows,
        "checks_failed": [c.name for c in statements if not c.ok],
    }
    second = {f: as_solution(o, o.averaged) for f, o in outcomes.items()}
    extra = {"sequential": _json(outcomes, shown, estimates, estimates_of(rig, terms, second)[0])}
    model = Model(rig, tuple(terms), estimates, covariance, provenance)
    return Identification(model, solutions, rows, masked, seconds, statements, extra, tuple(built))


def _stages(
    rig: Rig, terms: Sequence[Used], reductions: Sequence[RecordReduction]
) -> dict[str, list[StepRows]]:
    """Return the stages of each family in the order of the steps."""
    out: dict[str, list[StepRows]] = {}
    for family in FAMILIES:
        width = len(parameters_of(rig, terms, family)) + 1
        out[family] = []
        for step in dict.fromkeys(reduction.head.step for reduction in reductions):
            part = [reduction for reduction in reductions if reduction.head.step == step]
            noise = noise_of(part, family)
            clusters = tuple(clusters_of(part, family))
            if clusters:
                noise = np.zeros((width, width)) if noise is None else noise
                out[family].append(StepRows(step, clusters, noise))
        if not out[family]:
            raise InputError(f"every {family} row of the records is masked; take other records")
    return out


def _shown(
    rig: Rig, terms: Sequence[Used], outcomes: Mapping[str, StageOutcome], name: str
) -> list[tuple[str, Estimate]]:
    """Return every step's own value of one parameter, as an estimate in the parameter's unit."""
    family, outcome = next((f, o) for f, o in outcomes.items() if name in o.names)
    out = []
    for value in outcome.own[name]:
        solutions = {family: as_solution(outcome, {name: value})}
        out.append((value.step, estimates_of(rig, terms, solutions)[0][name]))
    return out


def disagreement(values: Sequence[Estimate]) -> float:
    """Return the largest difference of two values over their common 95 % half width."""
    halves = [v.half for v in values]
    return max(
        (
            abs(a.value - b.value) / float(np.hypot(halves[i], halves[j]))
            for i, a in enumerate(values)
            for j, b in enumerate(values[:i])
        ),
        default=0.0,
    )


def _uniqueness(shown: Mapping[str, Sequence[tuple[str, Estimate]]]) -> Check:
    """State which parameters have several values, and by how much the worst of them disagree."""
    several = {name: by_step for name, by_step in shown.items() if len(by_step) > 1}
    if not several:
        return Check("one value each", True, "no parameter is identified by more than one step")
    by_size = sorted(several, key=lambda n: -disagreement([e for _, e in several[n]]))
    texts = []
    for name in by_size[: IDENTIFY.worst_shown]:
        values = ", ".join(f"{step} {estimate.value:.5g}" for step, estimate in several[name])
        apart = disagreement([e for _, e in several[name]])
        texts.append(f"{name}: {values} ({apart:.1f} of their 95 % intervals apart)")
    return Check(
        "one value each", False,
        f"{len(several)} parameters have several values, worst: " + "; ".join(texts),
    )  # fmt: skip


def _json(
    outcomes: Mapping[str, StageOutcome],
    shown: Mapping[str, Sequence[tuple[str, Estimate]]],
    first: Mapping[str, Estimate],
    averaged: Mapping[str, Estimate],
) -> dict[str, Any]:
    taken = {n: v.step for o in outcomes.values() for n, v in o.first.items()}
    means = {n: v.step for o in outcomes.values() for n, v in o.averaged.items()}
    return {
        "steps": list(next(iter(outcomes.values())).condition),
        "per_step": {
            name: [{"step": step, **estimate_json(e)} for step, e in by_step]
            for name, by_step in shown.items()
        },
        "disagreement": {
            name: finite(disagreement([e for _, e in by_step]))
            for name, by_step in shown.items()
            if len(by_step) > 1
        },
        "E1": {n: {"step": taken.get(n), **estimate_json(e)} for n, e in first.items()},
        "E2": {n: {"steps": means.get(n), **estimate_json(e)} for n, e in averaged.items()},
        "condition_number": {
            family: {step: finite(c) for step, c in outcome.condition.items()}
            for family, outcome in outcomes.items()
        },
    }
