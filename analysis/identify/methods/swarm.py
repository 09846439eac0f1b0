"""PSO and GA on STEP1's parameters: the search methods that the paper compares with.

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
from importlib import import_module
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


_PYMOO = {
    "pso": "algorithms.soo.nonconvex.pso",
    "ga": "algorithms.soo.nonconvex.ga",
    "evaluator": "core.evaluator",
    "problem": "core.problem",
    "termination": "core.termination",
    "static": "problems.static",
}


@dataclass(frozen=True)
class SearchHistory:
    """A finished search: the best values, and the number of candidates that failed, by cause.

    `errors` (generations,) is the best error so far after each generation, `first` the best of the
    first one; `lost` counts candidates by cause, `lost_first` those of the first generation.
    """

    values: Mapping[str, float]
    error: float
    first: float
    evaluations: int
    errors: tuple[float, ...]
    sizes: tuple[int, ...]
    lost: Mapping[str, int]
    lost_first: int
    lost_by_generation: tuple[int, ...]
    seconds: float


def search(
    method: str,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    rng: np.random.Generator,
    options: SearchOptions,
) -> Identification:
    """Search STEP1's parameters by simulation; every other parameter is null.

    Raises InputError without a record that excites the last joint alone, without nominal values,
    or where every candidate lost its state.
    """
    rig = ck.common_rig(runs)
    record = single_joint_record(runs)
    ck.refuse_constant_channels(rig, record)
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
    """Let the algorithm propose generations until the evaluations are spent."""
    started = time.perf_counter()
    algorithm, evaluator, wrap = _pymoo(method, task, options, rng)
    best, best_error = np.zeros(len(task.names)), np.inf
    errors: list[float] = []
    sizes: list[int] = []
    lost = {COMPLEX: 0, DIVERGED: 0}
    gone: list[int] = []
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
        gone.append(sum(bool(s.failure) for s in scores))
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
    return SearchHistory(
        _values(task, best), best_error, errors[0], sum(sizes), tuple(errors), tuple(sizes),
        lost, gone[0], tuple(gone), seconds,
    )  # fmt: skip


def _pymoo(
    method: str, task: SearchTask, options: SearchOptions, rng: np.random.Generator
) -> tuple[Any, Any, Callable[[Array], Any]]:
    """Return pymoo's algorithm, its evaluator, and the wrapper of errors (n,) that it takes."""
    # An optional dependency, needed for searches only.
    try:
        core = {name: import_module(f"pymoo.{place}") for name, place in _PYMOO.items()}
    except ImportError as error:
        raise InputError(
            f"the methods pso and ga need the package pymoo ({error}); install bramah[search]"
        ) from error
    span = np.log10(task.high / task.low)
    problem = core["problem"].Problem(n_var=len(span), n_obj=1, xl=np.zeros(len(span)), xu=span)
    size = min(options.population, options.evaluations)
    algorithm = getattr(core[method], method.upper())(pop_size=size)
    seed = int(rng.integers(2**31))
    algorithm.setup(
        problem, termination=core["termination"].NoTermination(), seed=seed, verbose=False
    )
    static = core["static"].StaticProblem
    return (
        algorithm,
        core["evaluator"].Evaluator(),
        lambda errors: static(problem, F=errors[:, None]),
    )


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
    statements = _statements(method, runs, task, history)
    provenance = {
        "method": method,
        "runs": [run.source for run in runs],
        "records": [task.record],
        "evaluations": history.evaluations,
        "checks_failed": [c.name for c in statements if not c.ok],
    }
    model = Model(rig, used, estimates, covariance, provenance)
    rows = dict.fromkeys(FAMILIES, 0)
    extra = {"search": history_json(task, history, options)}
    return Identification(model, solutions, rows, 0, history.seconds, statements, extra)


def _as_solution(method: str, task: SearchTask, history: SearchHistory, family: str) -> Solution:
    """Return a family's values as a solution of no rows: no interval, no condition number."""
    best_values = inverted(task.model.rig, task.model.terms, history.values)
    names = parameters_of(task.model.rig, task.model.terms, family)
    nan = np.full(len(names), np.nan)
    value = np.array([best_values.get(name, np.nan) for name in names])
    lost = {
        n: f"{method} searches STEP1's parameters only" for n in names if n not in history.values
    }
    return Solution(names, value, np.diag(nan), nan, np.nan, 0, np.nan, nan, lost)


def _failures(history: SearchHistory) -> str:
    return ", ".join(f"{count} {failure}" for failure, count in history.lost.items())


def _statements(
    method: str, runs: Sequence[Run], task: SearchTask, history: SearchHistory
) -> tuple[Check, ...]:
    gone = sum(history.lost.values())
    share = 100.0 * gone / history.evaluations
    parameters = len(task.model.parameters)
    span = np.log10(task.high / task.low)
    place = np.array([np.log10(history.values[n] / low) for n, low in zip(task.names, task.low)])  # noqa: B905
    stuck = [
        name
        for name, x, width in zip(task.names, place, span, strict=True)
        if min(x, width - x) < IDENTIFY.at_bound * width
    ]
    records = [record for run in runs for record in run.records]
    return (
        Check(
            "state exists",
            gone == 0,
            f"{gone} of {history.evaluations} candidates ({share:.1f} %) lost their state: "
            f"{_failures(history)}; of the first {history.sizes[0]}, {history.lost_first}",
        ),
        Check(
            "all parameters",
            False,
            f"{len(task.names)} of {parameters}: {method} searches STEP1's parameters on record "
            f"{task.record!r} of {len(records)}; the others have no value, and none an interval",
        ),
        Check(
            "bounds",
            not stuck,
            f"{' '.join(stuck)} ended at a bound of the search"
            if stuck
            else "no parameter ended at a bound of the search",
        ),
        Check(
            "output error",
            True,
            f"best relative output error {history.error:.4g} (the first generation's best: "
            f"{history.first:.4g}); another search may end at other values",
        ),
    )


def history_json(
    task: SearchTask, history: SearchHistory, options: SearchOptions
) -> dict[str, Any]:
    """Return the search as plain data."""
    return {
        "record": task.record,
        "windows": [w.first for w in task.windows],
        "window_seconds": options.seconds,
        "evaluations": history.evaluations,
        "lost": dict(history.lost),
        "lost_first_generation": history.lost_first,
        "lost_by_generation": list(history.lost_by_generation),
        "generation_sizes": list(history.sizes),
        "error_first_generation": history.first if history.first < IDENTIFY.failed_error else None,
        "error": history.error,
        "error_by_generation": [e if e < IDENTIFY.failed_error else None for e in history.errors],
        "bounds": {
            name: [float(a), float(b)]
            for name, a, b in zip(task.names, task.low, task.high, strict=True)
        },
        "seconds": history.seconds,
    }
