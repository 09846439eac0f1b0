"""Performance figures of the analysis, as dicts."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms.base import family_of
from rig.cli.bench.timing import processor_time, processor_times
from rig.model.records import Run
from rig.model.rig import Rig


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return `repeats` synthetic records of each lock-and-excite step (two joints: three steps)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run) -> dict[str, Any]:
    """Return counts of records and rows, seconds of data, and times [s] of identification.

    `identify_seconds` includes `solve_seconds`. Processor times: `twelve` identifies the first
    twelve records; `solve` computes values and covariance from the records' triangular factors;
    `lstsq` computes the values alone from all rows with numpy's `lstsq`.
    """
    identify(
        [Run(run.rig, run.records[:1])]
    )  # excludes imports and FFT plans from the measured time
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
    return {
        "records": len(run.records),
        "data_seconds": sum(r.samples / r.sample_rate for r in run.records),
        "rows": sum(result.rows.values()),
        "identify_seconds": seconds,
        "solve_seconds": result.solve_seconds,
        "twelve": processor_time(lambda: identify([twelve])),
        **processor_times(works),
    }
