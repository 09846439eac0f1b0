"""The analysis' part of the performance figures, as dicts; nothing here prints."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from analysis.identify.identify import identify
from analysis.simulation.synthetic import multisine, synthetic_run
from rig.cli.bench.timing import spent
from rig.model.records import Run
from rig.model.rig import Rig


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return synthetic records of the lock-and-excite steps (two joints: 3 times `repeats`)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run) -> dict[str, Any]:
    """Return records, seconds of data, rows, identify_seconds in all and solve_seconds of it.

    `twelve` is the processor time of identifying the first twelve records.
    """
    identify([Run(run.rig, run.records[:1])])  # imports and FFT plans are not the method's
    started = time.perf_counter()
    result = identify([run])
    seconds = time.perf_counter() - started
    twelve = Run(run.rig, run.records[:12])
    return {
        "records": len(run.records),
        "data_seconds": sum(r.samples / r.sample_rate for r in run.records),
        "rows": sum(result.rows.values()),
        "identify_seconds": seconds,
        "solve_seconds": result.solve_seconds,
        "twelve": spent(lambda: identify([twelve])),
    }
