"""Solve the rows of an identification by the chosen estimator, with intervals and checks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.estimators import nuisance as nu
from analysis.identify.estimators.bootstrap import bootstrap
from analysis.identify.estimators.covariance import CovarianceParts, spread
from analysis.identify.estimators.equations import (
    EquationFit,
    FamilyBlocks,
    RepeatBlock,
    blocks_of,
    least_squares,
    pieces,
    with_common_rows,
)
from analysis.identify.estimators.instruments import (
    Hausman,
    hausman,
    instrumental_variables,
    steps_without_instruments,
)
from analysis.identify.estimators.robust import outlier_statement, robust
from analysis.identify.estimators.shifts import (
    including,
    largest_shift,
    noise_statement,
    nuisance_statement,
    predicted_shift,
    shift_without,
    shifts_of,
    significant_shift,
)
from analysis.identify.estimators.weighted import weighted_least_squares
from analysis.identify.stacked_rows import RecordRows, repeats_in_motion, with_columns
from analysis.regression.nonlinear import Linearisation, linearised
from analysis.regression.rows import parameters_of
from analysis.regression.solve import MOSTLY_NOISE, Solution
from analysis.terms.base import Used, inverted
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]

OUTPUT_ERROR = "output-error"
ESTIMATORS = ("ls", "wls", "iv", "robust", OUTPUT_ERROR, "auto")
NEED_REPEATS = ("wls", "iv")
# Output error is not among them: the measured spool that drives it is noisy as well, and at ten
# times the stated noise it is the most biased of all (docs/estimators.md).
UNBIASED = ("iv",)

_FITS: Mapping[str, Callable[[Sequence[RepeatBlock]], EquationFit]] = {
    "ls": least_squares,
    "wls": weighted_least_squares,
    "iv": instrumental_variables,
    "robust": robust,
}


@dataclass(frozen=True)
class EstimationJob:
    """Input of an estimation: rig, runs, the model's terms, and the rows built with them."""

    rig: Rig
    runs: Sequence[Run]
    terms: Sequence[Used]
    built: Sequence[RecordRows]
    estimator: str
    bootstrap: int
    rng: np.random.Generator | None


@dataclass(frozen=True)
class Refinement:
    """An estimator's solutions by family, its checks, and bootstrap intervals by coefficient."""

    solutions: dict[str, Solution]
    checks: tuple[Check, ...]
    estimator: str
    bootstrap: dict[str, tuple[float, float]] = field(default_factory=dict)


def refuse_unknown(estimator: str) -> None:
    """Raise InputError for an estimator that does not exist."""
    if estimator not in ESTIMATORS:
        raise InputError(f"unknown estimator {estimator!r}; known: {' '.join(ESTIMATORS)}")


def refine(job: EstimationJob, solutions: Mapping[str, Solution]) -> Refinement:
    """Solve again by the job's estimator, with nuisance columns and 95 % intervals.

    `solutions` are those of plain least squares; a parameter not identified by them stays so.
    Raises InputError for an estimator that needs repeats where a step has only one.
    """
    if job.rig.electric and job.estimator == OUTPUT_ERROR:
        from analysis.identify.output_error.free_run import free_run_fit  # noqa: PLC0415 - compiles

        fitted, check = free_run_fit(job.rig, job.runs, job.terms, solutions)
        return Refinement(fitted, (check,), job.estimator)
    repeat_counts = repeats_in_motion(
        job.rig, ((rows.conditioned.run, rows.record) for rows in job.built)
    )
    prepared, checks = _prepare(job, solutions)
    single_repeat = sorted(
        {step for (_, step), n in repeat_counts.items() if n < 2}.union(
            *(steps_without_instruments(p.blocks) for p in prepared)
        )
    )
    if single_repeat and job.estimator in NEED_REPEATS:
        raise InputError(
            f"--estimator {job.estimator} needs two or more repeats of every step, with the same "
            "excitation started at the same sample; these steps have one, or none that share a "
            f"row: {' '.join(single_repeat)}. Record more repeats (bramah run --repeats 4), or use "
            "--estimator output-error"
        )
    estimator = "ls" if job.estimator == "auto" else job.estimator
    plain = {p.family: _solve(p, "ls") for p in prepared}
    tests = {} if single_repeat else {p.family: _hausman(p) for p in prepared}
    if not single_repeat:
        errors = {family: error for family, (_, error, _) in plain.items()}
        statement = noise_statement(shifts_of(prepared, tests, errors))
        if job.estimator == "auto" and not statement.ok:
            estimator = "iv"
        if not statement.ok and estimator in UNBIASED:
            words = "; the values given are those of instrumental variables instead"
            statement = replace(statement, ok=True, detail=statement.detail + words)
        checks.append(statement)
    if estimator == OUTPUT_ERROR:
        from analysis.identify.output_error.fit import output_error  # noqa: PLC0415 - compiles

        values = {
            name: float(v)
            for p in prepared
            for name, v in zip(p.names, plain[p.family][0], strict=False)
        }
        done = output_error(job.rig, job.runs, job.terms, values)
        checks.append(done.check)
        updated = {f: merged(s, done.names, done.value, done.spread) for f, s in solutions.items()}
        return Refinement(updated, tuple(checks), estimator)
    fits = plain if estimator == "ls" else {p.family: _solve(p, estimator) for p in prepared}
    updated = dict(solutions)
    intervals: dict[str, tuple[float, float]] = {}
    for p in prepared:
        beta, total, fit = fits[p.family]
        shifts = list(p.omitted)
        if estimator == "ls" and tests:
            shifts.append(significant_shift(tests[p.family], p))
        elif estimator == "ls":
            shifts.append(predicted_shift(solutions[p.family], p))
        total = functools.reduce(including, shifts, total)
        updated[p.family] = merged(solutions[p.family], p.names[: p.parameters], beta, total)
        if estimator == "robust":
            checks.append(outlier_statement(p.family, fit))
        if job.bootstrap:
            intervals |= _intervals(job, p, estimator, sum(shifts, np.zeros(p.parameters)))
    return Refinement(updated, tuple(checks), estimator, intervals)


def _intervals(
    job: EstimationJob, p: FamilyBlocks, estimator: str, shift: Array
) -> dict[str, tuple[float, float]]:
    """Return the bootstrap's 95 % intervals by coefficient, extended by a shift (k,) of the value.

    The shift is the same in every repeat, so that resampling repeats does not show it.
    """
    rng = job.rng or np.random.default_rng(0)
    fit_blocks = _FITS[estimator]
    rows = _prior_rows(p, fit_blocks(p.blocks), estimator)

    def estimate(blocks: Sequence[RepeatBlock]) -> Array:
        return nu.with_prior_rows(fit_blocks(blocks), rows).beta[: p.parameters]

    low, high = bootstrap(p.blocks, estimate, job.bootstrap, rng)
    # Extended towards the value without this shift (by instruments, or with all nuisances).
    low, high = low - np.maximum(shift, 0.0), high - np.minimum(shift, 0.0)
    ends = zip(p.names, low, high, strict=False)
    return {name: (float(a), float(b)) for name, a, b in ends}


def _prepare(
    job: EstimationJob, solutions: Mapping[str, Solution]
) -> tuple[list[FamilyBlocks], list[Check]]:
    """Return each family's rows with its plausible nuisance columns, and a check for each."""
    coefficients = {
        name: float(v) for s in solutions.values() for name, v in zip(s.names, s.value, strict=True)
    }
    values = inverted(job.rig, job.terms, coefficients)
    extra = nu.nuisance_terms(job.terms, job.runs, values)
    built = with_columns(job.rig, job.terms, job.built, extra)
    checks: list[Check] = []
    out = []
    for family, solution in solutions.items():
        unknowns = parameters_of(job.rig, (*job.terms, *extra), family)
        linear = linearised(job.rig, job.terms, unknowns, values)
        columns = linear.names
        determined = [n for n in solution.names if n not in solution.unidentifiable]
        if not determined:
            continue
        nuisances = [c.parameter for used in extra for c in used.term.coefficients(job.rig)]
        # Without their columns, parameters excited by the same motion would absorb their share.
        noisy = [n for n, reason in solution.unidentifiable.items() if reason == MOSTLY_NOISE]
        nuisances = [*noisy, *(n for n in nuisances if n in columns and n not in determined)]
        names = (*determined, *nuisances)
        selected = [columns.index(name) for name in names]
        blocks = _linearised_blocks(built, family, linear, selected)
        prepared = FamilyBlocks(family, names, len(determined), blocks)
        if nuisances:
            prepared, stated = _without_implausible(prepared)
            checks += stated
        out.append(prepared)
    return out, checks


def _linearised_blocks(
    built: Sequence[RecordRows], family: str, linear: Linearisation, selected: Sequence[int]
) -> tuple[RepeatBlock, ...]:
    """Return one family's blocks with the columns `selected` of the parameters of `linear`."""
    if linear.is_identity:
        return tuple(blocks_of(built, family, selected))
    slope = linear.slope[:, list(selected)]
    return tuple(
        replace(block, X=block.X @ slope, y=block.y - block.X @ linear.constant)
        for block in blocks_of(built, family, range(len(linear.slope)))
    )


def _without_implausible(p: FamilyBlocks) -> tuple[FamilyBlocks, list[Check]]:
    """Return a family without the nuisances that its data contradict, with a check for each."""
    checks = []
    fit = least_squares(p.blocks)
    error = spread([pieces(fit)], fit.inverse)
    for name in p.names[p.parameters :]:
        # Recomputed for each name: leaving out a nuisance shifts the indices of the columns.
        prior = next((b for b in nu.priors(p.names, fit.beta) if b.name == name), None)
        if prior is None:
            continue
        if not nu.implausible(prior, fit, error):
            checks.append(nuisance_statement(prior, p.names, fit, error, None))
            continue
        reduced = _without_column(p, name)
        refitted = least_squares(reduced.blocks)
        shift = shift_without(fit.beta, refitted.beta, error, p.parameters)
        moved = largest_shift(p.names[: p.parameters], fit.beta[: p.parameters], shift)
        checks.append(nuisance_statement(prior, p.names, fit, error, moved))
        p = replace(reduced, omitted=(*p.omitted, shift))
        fit, error = refitted, spread([pieces(refitted)], refitted.inverse)
    return p, checks


def _without_column(p: FamilyBlocks, name: str) -> FamilyBlocks:
    """Return a family's blocks without the column `name`."""
    at = p.names.index(name)
    blocks = tuple(replace(b, X=np.delete(b.X, at, axis=1)) for b in p.blocks)
    return replace(p, names=(*p.names[:at], *p.names[at + 1 :]), blocks=blocks)


def _solve(p: FamilyBlocks, estimator: str) -> tuple[Array, CovarianceParts, EquationFit]:
    fit = _FITS[estimator](p.blocks)
    rows = _prior_rows(p, fit, estimator)
    fit = nu.with_prior_rows(fit, rows)
    error, k = nu.spread_with_priors(fit, rows), p.parameters
    error = CovarianceParts(error.covariance[:k, :k], error.dof[:k], error.systematic[:k])
    return fit.beta[:k], error, fit


def _prior_rows(p: FamilyBlocks, fit: EquationFit, estimator: str) -> tuple[nu.PriorRow, ...]:
    """Return the prior rows of the nuisances, weighted for a fit without prior rows."""
    plain = least_squares(fit.blocks) if estimator == "iv" else fit
    return nu.prior_rows(plain, nu.priors(p.names, plain.beta))


def _hausman(p: FamilyBlocks) -> Hausman:
    plain = least_squares(with_common_rows(p.blocks))
    return hausman(plain, _prior_rows(p, plain, "ls"))


def merged(
    solution: Solution, names: Sequence[str], beta: Array, error: CovarianceParts
) -> Solution:
    """Return the solution with value, covariance and dof replaced for those of `names` it has."""
    shared = [k for k, name in enumerate(names) if name in solution.names]
    indices = [solution.names.index(names[k]) for k in shared]
    value, dof = solution.value.copy(), solution.dof.copy()
    covariance = solution.covariance.copy()
    value[indices], dof[indices] = beta[shared], error.dof[shared]
    covariance[np.ix_(indices, indices)] = error.covariance[np.ix_(shared, shared)]
    return replace(solution, value=value, covariance=covariance, dof=dof)
