"""The coupled method (the paper's STEP4): the rows of all steps stacked and solved once."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.supply import BULK, PortEffect
from analysis.identify import checks as ck
from analysis.identify.advice import base_statements
from analysis.identify.checks import Check, consistency
from analysis.identify.estimation import (
    OUTPUT_ERROR,
    UNBIASED,
    EstimationJob,
    Refinement,
    refine,
)
from analysis.identify.geometry import GeometryShifts, geometry_check, shifts_of_rows
from analysis.identify.reduction import (
    RecordReduction,
    record_checks,
    reduce_rows,
    solve_reductions,
)
from analysis.identify.result import PLAIN, Identification, estimates_of, with_ends
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import Filtering, default_filtering
from analysis.regression.solve import Solution
from analysis.simulation.model import Model
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig

log = logging.getLogger(__name__)

_UNREFINED = Check(
    "estimator",
    True,
    "plain: least squares with intervals from the scatter between repeats alone; the other "
    "estimators, which need every row in memory, were not applied",
)


def coupled(
    runs: Sequence[Run],
    used: tuple[Used, ...],
    filtering: Callable[[Record], Filtering] = default_filtering,
    reject_noise: bool = True,
    estimator: str = "auto",
    bootstrap: int = 0,
    rng: np.random.Generator | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Identify all parameters of the terms `used` from all records of the runs at once.

    The arguments are those of `analysis.identify.identify.identify`, checked there. Raises
    InputError for runs of different rigs and for records that cannot be used.
    """
    rig = ck.common_rig(runs)
    _refuse_nonlinear(rig, used, estimator)
    built = build_rows(rig, runs, used, filtering, progress)
    job = EstimationJob(rig, runs, used, built, estimator, bootstrap, rng)
    result = conclude(
        rig,
        [run.source for run in runs],
        used,
        reduce_rows(rig, used, built),
        reject_noise,
        None if estimator == PLAIN else functools.partial(refine, job),
        shifts_of_rows(rig, used, built),
    )
    return replace(result, built=tuple(built))


def with_identified_bulk_modulus(
    runs: Sequence[Run], terms: Sequence[Used], *more: Sequence[Run]
) -> tuple[tuple[Run, ...], ...]:
    """Return `runs` and `more` with the b [Pa] identified from `runs` as their rigs' nominal value.

    Effects on the pressure at the valves' ports need the flow through them, A s' + V p' / b, in the
    rows from which b is identified; a nominal b may be wrong by a factor of 2. So b is identified
    first without these effects. The runs are unchanged where b is no parameter or not identified.
    Raises InputError as `coupled` does.
    """
    groups = (tuple(runs), *map(tuple, more))
    rig = runs[0].rig
    reduced_terms = tuple(used for used in terms if not isinstance(used.term, PortEffect))
    if not any(c.parameter == BULK for used in reduced_terms for c in used.term.parameters(rig)):
        return groups
    b = coupled(runs, reduced_terms, estimator="ls").estimates.get(BULK)
    if b is None or not b.identified or b.value <= 0.0:
        return groups
    value = b.value

    def with_nominal(run: Run) -> Run:
        nominal = {**run.rig.nominal, BULK: value}
        return replace(run, rig=run.rig.model_copy(update={"nominal": nominal}))

    return tuple(tuple(map(with_nominal, part)) for part in groups)


def conclude(
    rig: Rig,
    sources: Sequence[str],
    used: tuple[Used, ...],
    reductions: Sequence[RecordReduction],
    reject_noise: bool = True,
    refined: Callable[[Mapping[str, Solution]], Refinement] | None = None,
    geometry: GeometryShifts | None = None,
) -> Identification:
    """Solve the reductions of all records of the runs `sources`, and check the result.

    `refined` applies an estimator to the solutions of plain least squares; `geometry` widens the
    intervals by the uncertainty of the rig's geometry.
    """
    started = time.perf_counter()
    solutions = solve_reductions(rig, used, reductions, reject_noise)
    seconds = time.perf_counter() - started
    refinement = (
        Refinement(solutions, (_UNREFINED,), PLAIN) if refined is None else refined(solutions)
    )
    solutions = refinement.solutions
    estimates, covariance = estimates_of(rig, used, solutions)
    if refinement.bootstrap:
        estimates = with_ends(estimates, refinement.bootstrap)
    geometry_checks = (geometry_check(estimates, geometry),) if "fluid" in rig.families else ()
    if geometry is not None:
        estimates, covariance = geometry.widened(estimates, covariance)
    rows = {family: solution.rows for family, solution in solutions.items()}
    masked = sum(reduction.masked for reduction in reductions)
    statements = (
        *record_checks(rig, reductions, rows),
        *ck.identifiability(solutions),
        *base_statements(rig, solutions),
        ck.noise_bias(solutions, refinement.estimator in UNBIASED),
        *consistency(rig, estimates),
        *refinement.checks,
        *geometry_checks,
    )
    provenance = {
        "method": "coupled",
        "estimator": refinement.estimator,
        "runs": list(sources),
        "records": [reduction.head.name for reduction in reductions],
        "rows": rows,
    }
    model = Model(rig, used, estimates, covariance, provenance)
    log.info("identified %d parameters from %d records", len(estimates), len(reductions))
    result = Identification(model, solutions, masked, seconds, geometry=geometry)
    return result.with_checks(statements)


def _refuse_nonlinear(rig: Rig, used: Sequence[Used], estimator: str) -> None:
    """Raise InputError for output error with parameters that are not linear in the rows."""
    reducing = [use.term.name for use in used if use.term.reduction(rig) is not None]
    if reducing and estimator == OUTPUT_ERROR:
        raise InputError(
            f"--estimator {estimator} does not go with {' '.join(reducing)}, not linear in the "
            "rows: take another estimator"
        )
