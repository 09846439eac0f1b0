"""Identification: runs in, parameters with intervals, checks and a model out."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.identify.advice import base_statements
from analysis.identify.checks import Check
from analysis.identify.estimates import estimates_of, with_ends
from analysis.identify.estimation import UNBIASED, Job, Refined, refine, refuse_unknown
from analysis.identify.plausibility import consistency
from analysis.identify.reduction import SEGMENTS, Reduction, reduce_runs, solve_reductions
from analysis.identify.reduction import repeats_of as reduced_repeats
from analysis.regression.nonlinear import reduced
from analysis.regression.rows import Filtering, Rows, default_filtering, parameters_of, record_rows
from analysis.regression.solve import Cluster, Solution, solve, triangle
from analysis.signals.conditioning import condition
from analysis.signals.locks import moving_by_step
from analysis.simulation.model import Estimate, Model, estimate_json, finite
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig

if TYPE_CHECKING:
    from analysis.identify.methods.search import SearchOptions

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

METHODS = ("coupled", "sequential", "simultaneous", "pso", "ga")
PLAIN = "plain"  # least squares as in the paper: no nuisances, scatter between repeats only
FEWEST_DRAWS = 100  # of a bootstrap
_UNREFINED = Check(
    "estimator",
    True,
    "plain: least squares with intervals from the scatter between repeats alone; what the other "
    "estimators refine (every row in memory, parameters linear in them) was not applied",
)


@dataclass(frozen=True)
class RecordRows:
    """The rows of one record by equation, and which run, step and repeat it is."""

    run: int
    record: str
    step: str
    repeat: int
    rows: Mapping[str, Rows]


@dataclass(frozen=True)
class Identification:
    """What an identification found: estimates, conditioning, rows used and left out, checks."""

    method: str
    estimates: Mapping[str, Estimate]
    solutions: Mapping[str, Solution]
    rows: Mapping[str, int]
    masked_rows: int
    solve_seconds: float
    checks: tuple[Check, ...]
    model: Model
    extra: Mapping[str, Any] = field(default_factory=dict)  # a method's own figures, plain data


def identify(
    runs: Sequence[Run],
    method: str = "coupled",
    terms: Sequence[Used] | None = None,
    filtering: Callable[[Record], Filtering] = default_filtering,
    reject_noise: bool = True,
    estimator: str = "auto",
    bootstrap: int = 0,
    rng: np.random.Generator | None = None,
    search: SearchOptions | None = None,
) -> Identification:
    """Identify all parameters from all records of the runs at once (the paper's STEP4).

    `terms` defaults to the paper's model. `reject_noise` False gives out parameters that rest on
    sensor noise as well, for studies of just that. Another `method` is `analysis.identify.methods`'
    work, `search` being for those that search. `estimator` is one of
    `analysis.identify.estimation.ESTIMATORS` ("auto": least squares, or instruments where noise in
    the regressors biases it and that matters), "plain" the bare solution without nuisances;
    `bootstrap` draws of whole repeats replace the intervals; `rng` is for what is drawn (default:
    seed 0). Raises InputError for another method or estimator, for runs
    of different rigs and for records that cannot be used, naming record and channel.
    """
    _refuse_method(method)
    _refuse_estimator(estimator, bootstrap)
    rig = ck.common_rig(runs)
    used = tuple(terms) if terms is not None else tuple(map(Used, baseline_of(rig)))
    estimator = _fitting_estimator(rig, used, estimator, bootstrap)
    if method != "coupled":
        from analysis.identify.methods import identify_by  # noqa: PLC0415 (which builds on this module)

        return identify_by(method, runs, used, filtering, reject_noise, rng, search)

    def refined(solutions: Mapping[str, Solution]) -> Refined:
        if rig.electric:
            from analysis.identify.output_error.free_run import free_run_fit  # noqa: PLC0415 - compiles

            found, check = free_run_fit(rig, runs, used, solutions)
            return Refined(found, (check,), estimator)
        job = Job(
            rig, runs, used, lambda extra: build_rows(rig, runs, (*used, *extra), filtering),
            estimator, bootstrap, rng or np.random.default_rng(0),
        )  # fmt: skip
        return refine(job, solutions)

    reductions = reduce_runs(rig, runs, used, filtering)
    sources = [run.source for run in runs]
    return conclude(
        rig, sources, used, reductions, reject_noise, None if estimator == PLAIN else refined
    )


def conclude(
    rig: Rig,
    sources: Sequence[str],
    used: tuple[Used, ...],
    reductions: Sequence[Reduction],
    reject_noise: bool,
    refined: Callable[[Mapping[str, Solution]], Refined] | None = None,
) -> Identification:
    """Solve the reductions of all records of the runs `sources`, and judge what comes out."""
    started = time.perf_counter()
    solutions = solve_reductions(rig, used, reductions, reject_noise)
    seconds = time.perf_counter() - started
    found = Refined(solutions, (_UNREFINED,), PLAIN) if refined is None else refined(solutions)
    solutions = found.solutions
    estimates, covariance = estimates_of(rig, used, solutions)
    if found.bootstrap:
        estimates = with_ends(estimates, found.bootstrap)
    rows = {family: solution.rows for family, solution in solutions.items()}
    masked = sum(one.masked for one in reductions)
    statements = (
        *_statements(rig, reductions, found, estimates, rows, masked),
        *found.checks,
    )
    provenance = {
        "method": "coupled",
        "estimator": found.estimator,
        "runs": list(sources),
        "records": [one.head.name for one in reductions],
        "rows": rows,
        "checks_failed": [c.name for c in statements if not c.ok],
    }
    model = Model(rig, used, estimates, covariance, provenance)
    log.info("identified %d parameters from %d records", len(estimates), len(reductions))
    return Identification("coupled", estimates, solutions, rows, masked, seconds, statements, model)


def _refuse_method(method: str) -> None:
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}; known: {' '.join(METHODS)}")


def _refuse_estimator(estimator: str, bootstrap: int) -> None:
    if estimator != PLAIN:
        refuse_unknown(estimator)
    if bootstrap and bootstrap < FEWEST_DRAWS:
        raise InputError(
            f"{bootstrap} bootstrap draws tell no 95 % interval; take {FEWEST_DRAWS} or more"
        )
    if bootstrap and estimator in (PLAIN, "output-error"):
        raise InputError(f"--bootstrap does not go with --estimator {estimator}; take ls or iv")


def _fitting_estimator(rig: Rig, used: Sequence[Used], estimator: str, bootstrap: int) -> str:
    """Return the estimator for a model: what refines the fluid's rows has none on electric rigs.

    Those have plain least squares and output error. None but the plain one is for parameters that
    are not linear in the rows (`Term.reduction`).
    """
    reducing = [one.term.name for one in used if one.term.reduction(rig) is not None]
    if estimator == PLAIN or not (rig.electric or reducing):
        return estimator
    if estimator == "output-error" and not reducing and not bootstrap:
        return estimator
    if estimator not in ("ls", "auto") or bootstrap:
        asked = "--bootstrap" if estimator in ("ls", "auto") else f"--estimator {estimator}"
        why = (
            f"is for hydraulic rigs; {rig.name!r} is electric"
            if rig.electric
            else f"does not go with {' '.join(reducing)}, not linear in the rows"
        )
        also = " or output-error" if rig.electric and not reducing else ""
        raise InputError(f"{asked} {why}: take ls{also} without a bootstrap")
    return PLAIN


def build_rows(
    rig: Rig,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering] = default_filtering,
) -> list[RecordRows]:
    """Return the filtered, decimated rows of every record; raises InputError for a bad one."""
    built = []
    for index, run in enumerate(runs):
        moving = moving_by_step(rig, run)
        for record in run.records:
            ck.refuse_dead_channels(rig, record)
            filters = filtering(record)
            signals = condition(rig, record, filters.channels, moving.get(record.step))
            rows = record_rows(rig, terms, signals, filters)
            built.append(RecordRows(index, record.name, record.step, record.repeat, rows))
    return built


def repeats_of(per_record: Sequence[RecordRows]) -> dict[tuple[int, str], int]:
    """Count the repeats of every (run, step)."""
    seen: dict[tuple[int, str], set[int]] = {}
    for one in per_record:
        seen.setdefault((one.run, one.step), set()).add(one.repeat)
    return {key: len(values) for key, values in seen.items()}


def solve_rows(
    rig: Rig,
    terms: Sequence[Used],
    per_record: Sequence[RecordRows],
    noise: Mapping[str, Array] | None = None,
    reject_noise: bool = True,
) -> dict[str, Solution]:
    """Reduce the rows to one triangle per cluster and solve each family once."""
    repeats = repeats_of(per_record)
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, terms, family)
        clusters: list[Cluster] = []
        for one in per_record:
            clusters += clusters_of(one, family, repeats)
        if names:
            moments = noise[family] if noise else None
            linear = solve(names, clusters, moments, reject_noise)
            out[family] = reduced(rig, terms, linear, clusters, moments, reject_noise)
    return out


def clusters_of(
    one: RecordRows, family: str, repeats: Mapping[tuple[int, str], int]
) -> list[Cluster]:
    """Reduce a record's rows of one family to a triangle, or to several of an only repeat."""
    pieces = 1 if repeats[one.run, one.step] > 1 else SEGMENTS
    out = []
    rows = [r for name, r in one.rows.items() if family_of(name) == family]
    for piece in range(pieces):
        parts = [_piece(r, piece, pieces) for r in rows]
        count = sum(len(rhs) for _, rhs in parts)
        if count:
            matrix = np.concatenate([m for m, _ in parts])
            rhs = np.concatenate([y for _, y in parts])
            key: Hashable = one.repeat if pieces == 1 else (one.repeat, piece)
            out.append(Cluster((one.run, one.step), key, triangle(matrix, rhs), count))
    return out


def _piece(rows: Rows, piece: int, pieces: int) -> tuple[Array, Array]:
    edges = np.linspace(0, len(rows.rhs), pieces + 1).astype(int)
    inside = slice(edges[piece], edges[piece + 1])
    return rows.matrix[inside], rows.rhs[inside]


def _statements(
    rig: Rig,
    reductions: Sequence[Reduction],
    found: Refined,
    estimates: Mapping[str, Estimate],
    rows: Mapping[str, int],
    masked: int,
) -> tuple[Check, ...]:
    return (
        ck.repeats(reduced_repeats(reductions)),
        ck.joints_excited(rig, [one.head for one in reductions]),
        *ck.clipping(rig, [(one.head, one.clipped) for one in reductions]),
        ck.lost_samples([(one.head, one.lost) for one in reductions]),
        ck.masked(sum(rows.values()), masked),
        *ck.identifiability(found.solutions),
        *base_statements(rig, found.solutions),
        ck.noise_bias(found.solutions, found.estimator in UNBIASED),
        *consistency(rig, estimates),
    )


def to_json(result: Identification) -> dict[str, Any]:
    """Return the identification as the contract's JSON; null where a number does not exist."""
    return {
        "method": result.method,
        "estimator": str(result.model.provenance.get("estimator", PLAIN)),
        "parameters": {name: estimate_json(p) for name, p in result.estimates.items()},
        "condition_number": {
            family: finite(s.condition_number) for family, s in result.solutions.items()
        },
        "rows": dict(result.rows),
        "masked_rows": result.masked_rows,
        "solve_seconds": result.solve_seconds,
        "checks": [{"name": c.name, "ok": bool(c.ok), "detail": c.detail} for c in result.checks],
        "residual_rms": {family: finite(s.residual_rms) for family, s in result.solutions.items()},
        **result.extra,
    }
