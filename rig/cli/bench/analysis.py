"""The analysis' part of the performance figures, as dicts; nothing here prints."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.identify.stacked_rows import build_rows
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import baseline_of
from analysis.terms.base import Used
from rig.cli.bench.timing import spent, spent_together
from rig.model.records import Run
from rig.model.rig import Rig


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return synthetic records of the lock-and-excite steps (two joints: 3 times `repeats`)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run) -> dict[str, Any]:
    """Return records, seconds of data, rows, identify_seconds in all and solve_seconds of it.

    `twelve` is the processor time of identifying the first twelve records; `solve` and `lstsq` of
    solving the rows of all, and of numpy's lstsq on the same stacked rows.
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
        **_solve_and_lstsq(run),
    }


def _solve_and_lstsq(run: Run) -> dict[str, Any]:
    """Return the processor time of the solution with its intervals, and of numpy's lstsq alone."""
    rig = run.rig
    used = tuple(map(Used, baseline_of(rig)))
    built = build_rows(rig, [run], used)
    stacks = []
    for family in rig.families:
        rows = [r for one in built for r in one.family(family)]
        stacks.append((np.concatenate([r.matrix for r in rows]), [r.rhs for r in rows]))
    sides = [np.concatenate(parts) for _, parts in stacks]
    return spent_together(
        {
            "solve": lambda: solve_reductions(
                run.rig, used, reduce_rows(run.rig, used, built), True
            ),
            "lstsq": lambda: [
                np.linalg.lstsq(X, y) for (X, _), y in zip(stacks, sides, strict=True)
            ],
        }
    )
