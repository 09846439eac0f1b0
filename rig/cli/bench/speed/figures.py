"""Times of the analysis and the plant, and those of their reference programs."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms.base import family_of
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.cli.bench.figure import Figure, ProcessorTime, processor_time, processor_times
from rig.cli.bench.plant import hard_laws
from rig.cli.bench.speed.free_run import free_run_times
from rig.model.records import Run
from rig.model.rig import Rig

BLOCK, TICKS = 10, 5000


def ratio_figures(
    group: str,
    name: str,
    measured: ProcessorTime,
    anchor: tuple[str, ProcessorTime] | None,
    limit: float | None,
) -> list[Figure]:
    """Return a time, its reference and their ratio; `limit` bounds the ratio, else the time."""
    bound = None if anchor else limit
    figures = [
        Figure(group, name, 1e3 * measured.least, "ms", bound),
        Figure(group, f"{name}, median", 1e3 * measured.median, "ms"),
    ]
    if anchor is None:
        return figures
    other, reference = anchor
    return [
        *figures,
        Figure(group, other, 1e3 * reference.least, "ms"),
        Figure(group, f"{other}, median", 1e3 * reference.median, "ms"),
        Figure(group, f"{name} over {other}", measured.least / reference.least, "x as long", limit),
    ]


def free_run_figures(rig: Rig) -> list[Figure]:
    """Measure a free run of 10 s and other solvers of the same equations."""
    group, times = "analysis", free_run_times(rig)
    bramah, hand = times["bramah"], times["hand"]
    figures = [
        *ratio_figures(
            group, "free run of 10 s, both joints", bramah, ("the same by hand", hand), 1.4
        ),
        Figure(group, "free run", times["times_real_time"], "x real time", 500, True),
        Figure(group, "difference of the two", times["difference_to_hand"], "rad", 1e-9),
        Figure(group, "its largest error over a state's range", times["error"]),
    ]
    for name, limit in (("odeint", 9.0), ("cvodes", 14.0)):
        if name in times:
            other = times[name]
            figures += [
                Figure(group, f"{name}, as exact", 1e3 * other.least, "ms"),
                Figure(group, f"{name}, median", 1e3 * other.median, "ms"),
                Figure(group, f"{name}, its error", times[f"{name}_error"]),
                Figure(
                    group,
                    f"{name} over free run",
                    other.least / bramah.least,
                    "x as long",
                    limit,
                    True,
                ),
            ]
    return figures


def plant_over_kernel(rig: Rig) -> list[Figure]:
    """Measure the plant in blocks of 10 ticks, as served, and in one call of its compiled loop."""

    def run(ticks: int) -> Callable[[], None]:
        plant, laws = Plant(rig, Scenario(), 1), hard_laws(rig)

        def work() -> None:
            for _ in range(TICKS // ticks):
                plant.advance(ticks, laws)

        return work

    times = processor_times({"blocks": run(BLOCK), "kernel": run(TICKS)})
    blocks, kernel = times["blocks"], times["kernel"]
    seconds = TICKS / rig.sample_rate
    return [
        Figure("plant", "in blocks of 10", seconds / blocks.least, "x real time", 160, True),
        *ratio_figures("plant", "5 s in blocks of 10", blocks, ("5 s at once", kernel), 1.1),
    ]


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return `repeats` synthetic records of each lock-and-excite step (two joints: three steps)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run, loading: float) -> list[Figure]:
    """Measure identification from a run that was loaded in `loading` [s], and parts of it.

    Processor times: of identifying the first twelve records; of the solve, which computes values
    and covariance from the records' triangular factors; of numpy's `lstsq`, which computes the
    values alone from all rows.
    """
    identify([Run(run.rig, run.records[:1])])  # imports and FFT plans are not measured
    started = time.perf_counter()
    result = identify([run])
    seconds = time.perf_counter() - started
    twelve = Run(run.rig, run.records[:12])
    terms = result.model.terms
    reductions = reduce_rows(run.rig, terms, result.built)
    rows = [(family_of(name), r) for item in result.built for name, r in item.rows.items()]
    stacked = [
        (
            np.concatenate([r.matrix for of, r in rows if of == family]),
            np.concatenate([r.rhs for of, r in rows if of == family]),
        )
        for family in sorted({of for of, _ in rows})
    ]
    works: dict[str, Callable[[], object]] = {
        "solve": lambda: solve_reductions(run.rig, terms, reductions),
        "lstsq": lambda: [np.linalg.lstsq(X, y, rcond=None) for X, y in stacked],
    }
    first = processor_time(lambda: identify([twelve]))
    times = processor_times(works)
    return [
        Figure("analysis", "records of 10 s", len(run.records)),
        Figure("analysis", "load and identify", loading + seconds, "s", 5.0),
        Figure("analysis", "of it the solve", 1e3 * result.solve_seconds, "ms", 50.0),
        *ratio_figures("analysis", "solve", times["solve"], ("numpy's lstsq", times["lstsq"]), 1.1),
        *ratio_figures("analysis", "identify 12 of them", first, None, 300.0),
    ]
