"""Search STEP1's parameters by PSO or GA, the search methods that the paper compares with.

The algorithms are pymoo's (Blank and Deb, pymoo: Multi-objective optimization in Python, 2020):
it has both, takes a seed instead of numpy's global generator, and offers ask-and-tell, so that
every candidate is simulated and counted here. PSO is its adaptive form, GA its real-coded form
(simulated binary crossover, polynomial mutation). Both search the decades of value / nominal.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.identify.checks import Check
from analysis.identify.methods.search import (
    COMPLEX,
    DIVERGED,
    SearchOptions,
    SearchTask,
    make_task,
    score,
    single_joint_record,
)
from analysis.identify.result import Identification, estimates_of
from analysis.identify.settings import IDENTIFY
from analysis.regression.rows import Filtering, parameters_of
from analysis.regression.solve import Solution
from analysis.simulation.model import Model
from analysis.terms.base import FAMILIES, Used, inverted
from rig.model.parse import InputError
from rig.model.records import Record, Run

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SearchHistory:
    """A finished search: the best values, and the number of candidates lost, by cause.

    A lost candidate could not be simulated. By generation: the best error so far (`errors`), the
    number of candidates (`sizes`) and of lost ones.
    """

    values: Mapping[str, float]
    lost: Mapping[str, int]
    errors: list[float]
    sizes: list[int]
    lost_by_generation: list[int]
    seconds: float

    @property
    def error(self) -> float:
        """The best error of all."""
        return self.errors[-1]

    @property
    def evaluations(self) -> int:
        """The number of candidates."""
        return sum(self.sizes)


def search_parameters(
    method: str,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    rng: np.random.Generator,
    options: SearchOptions,
) -> Identification:
    """Search STEP1's parameters by simulation; every other parameter is NaN.

    Raises InputError without a record that excites the last joint alone, without nominal values,
    or where no candidate can be simulated.
    """
    rig = ck.common_rig(runs)
    record = single_joint_record(runs)
    ck.refuse_constant_channels(rig, record, ck.spans_of(record))
    task = make_task(rig, record, terms, filtering(record), options)
    history = run_search(method, task, options, rng)
    if history.error >= IDENTIFY.failed_error:
        raise InputError(
            f"{method}: every one of {history.evaluations} candidates lost its state "
            f"({_failures(history)}); try more --evaluations"
        )
    return _identification(method, runs, task, history, options)


def run_search(
    method: str, task: SearchTask, options: SearchOptions, rng: np.random.Generator
) -> SearchHistory:
    """Simulate the generations that the algorithm proposes, `options.evaluations` candidates."""
    started = time.perf_counter()
    algorithm, evaluator, wrap = _pymoo(method, task, options, rng)
    best, best_error = np.zeros(len(task.names)), np.inf
    errors: list[float] = []
    sizes: list[int] = []
    lost = {COMPLEX: 0, DIVERGED: 0}
    lost_by_generation: list[int] = []
    while True:
        population = algorithm.ask()
        if population is None or not len(population):
            break
        if sum(sizes) + len(population) > options.evaluations:
            break
        points = np.asarray(population.get("X"), dtype=np.float64)
        scores = [score(task, _values(task, x)) for x in points]
        scored = np.array([s.error for s in scores])
        sizes.append(len(scores))
        lost_by_generation.append(sum(bool(s.failure) for s in scores))
        for s in scores:
            if s.failure:
                lost[s.failure] += 1
        if scored.min() < best_error:
            best, best_error = points[int(scored.argmin())], float(scored.min())
        errors.append(best_error)
        evaluator.eval(wrap(scored), population)
        algorithm.tell(infills=population)
    seconds = time.perf_counter() - started
    log.info("%s: %d candidates in %.1f s, %s lost", method, sum(sizes), seconds, lost)
    return SearchHistory(_values(task, best), lost, errors, sizes, lost_by_generation, seconds)


def _pymoo(
    method: str, task: SearchTask, options: SearchOptions, rng: np.random.Generator
) -> tuple[Any, Any, Callable[[Array], Any]]:
    """Return pymoo's algorithm, its evaluator, and the wrapper of errors (n,) that it takes."""
    try:  # an optional dependency, needed for searches only
        from pymoo.algorithms.soo.nonconvex.ga import GA  # noqa: PLC0415
        from pymoo.algorithms.soo.nonconvex.pso import PSO  # noqa: PLC0415
        from pymoo.core.evaluator import Evaluator  # noqa: PLC0415
        from pymoo.core.problem import Problem  # noqa: PLC0415
        from pymoo.core.termination import NoTermination  # noqa: PLC0415
        from pymoo.problems.static import StaticProblem  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            f"the methods pso and ga need the package pymoo ({error}); install bramah[search]"
        ) from error
    span = np.log10(task.high / task.low)
    problem = Problem(n_var=len(span), n_obj=1, xl=np.zeros(len(span)), xu=span)
    size = min(options.population, options.evaluations)
    algorithm = PSO(pop_size=size) if method == "pso" else GA(pop_size=size)
    seed = int(rng.integers(2**31))
    algorithm.setup(problem, termination=NoTermination(), seed=seed, verbose=False)
    return algorithm, Evaluator(), lambda errors: StaticProblem(problem, F=errors[:, None])


def _values(task: SearchTask, point: Array) -> dict[str, float]:
    return dict(zip(task.names, map(float, task.low * 10.0**point), strict=True))


def _identification(
    method: str,
    runs: Sequence[Run],
    task: SearchTask,
    history: SearchHistory,
    options: SearchOptions,
) -> Identification:
    rig, used = task.model.rig, task.model.terms
    solutions = {family: _as_solution(method, task, history, family) for family in FAMILIES}
    estimates, covariance = estimates_of(rig, used, solutions)
    provenance = {
        "method": method,
        "runs": [run.source for run in runs],
        "records": [task.record],
        "evaluations": history.evaluations,
    }
    model = Model(rig, used, estimates, covariance, provenance)
    extra = {"search": history_json(task, history, options)}
    result = Identification(model, solutions, 0, history.seconds, extra=extra)
    return result.with_checks(_statements(method, runs, task, history))


def _as_solution(method: str, task: SearchTask, history: SearchHistory, family: str) -> Solution:
    """Return a family's values as a solution of no rows: no interval, no condition number."""
    best_values = inverted(task.model.rig, task.model.terms, history.values)
    names = parameters_of(task.model.rig, task.model.terms, family)
    nan = np.full(len(names), np.nan)
    value = np.array([best_values.get(name, np.nan) for name in names])
    reasons = {
        n: f"{method} searches STEP1's parameters only" for n in names if n not in history.values
    }
    return Solution(names, value, np.diag(nan), nan, np.nan, 0, np.nan, nan, reasons)


def _failures(history: SearchHistory) -> str:
    return ", ".join(f"{count} {failure}" for failure, count in history.lost.items())


def _statements(
    method: str, runs: Sequence[Run], task: SearchTask, history: SearchHistory
) -> tuple[Check, ...]:
    failed = sum(history.lost.values())
    share = 100.0 * failed / history.evaluations
    parameters = len(task.model.parameters)
    at_bounds = []
    for name, low, high in zip(task.names, task.low, task.high, strict=True):
        distance, width = np.log10(history.values[name] / low), np.log10(high / low)
        if min(distance, width - distance) < IDENTIFY.at_bound * width:
            at_bounds.append(name)
    records = [record for run in runs for record in run.records]
    return (
        Check(
            "state exists",
            failed == 0,
            f"{failed} of {history.evaluations} candidates ({share:.1f} %) lost their state: "
            f"{_failures(history)}; of the first {history.sizes[0]}, "
            f"{history.lost_by_generation[0]}",
        ),
        Check(
            "all parameters",
            False,
            f"{len(task.names)} of {parameters}: {method} searches STEP1's parameters on record "
            f"{task.record!r} of {len(records)}; the others have no value, and none an interval",
        ),
        Check(
            "bounds",
            not at_bounds,
            f"{' '.join(at_bounds)} ended at a bound of the search"
            if at_bounds
            else "no parameter ended at a bound of the search",
        ),
        Check(
            "output error",
            True,
            f"best relative output error {history.error:.4g} (the first generation's best: "
            f"{history.errors[0]:.4g}); another search may end at other values",
        ),
    )


def history_json(
    task: SearchTask, history: SearchHistory, options: SearchOptions
) -> dict[str, Any]:
    """Return the search as JSON data."""
    errors = [e if e < IDENTIFY.failed_error else None for e in history.errors]
    return {
        "record": task.record,
        "windows": [w.first for w in task.windows],
        "window_seconds": options.seconds,
        "evaluations": history.evaluations,
        "lost": dict(history.lost),
        "lost_first_generation": history.lost_by_generation[0],
        "lost_by_generation": history.lost_by_generation,
        "generation_sizes": history.sizes,
        "error_first_generation": errors[0],
        "error": history.error,
        "error_by_generation": errors,
        "bounds": {
            name: [float(a), float(b)]
            for name, a, b in zip(task.names, task.low, task.high, strict=True)
        },
        "seconds": history.seconds,
    }
