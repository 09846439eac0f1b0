"""The analysis' part of the performance figures, as dicts; nothing here prints."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from analysis.identify.identify import identify
from analysis.signals.conditioning import condition
from analysis.simulation.model import Model
from analysis.simulation.simulate import (
    DrivingInput,
    State,
    compiled,
    drive_of,
    rates_of,
    simulate,
    state_at,
)
from analysis.simulation.synthetic import multisine, synthetic_run
from rig.model.records import Run
from rig.model.rig import Rig


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return synthetic records of the lock-and-excite steps (two joints: 3 times `repeats`)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run) -> dict[str, Any]:
    """Return records, seconds of data, rows, identify_seconds in all and solve_seconds of it."""
    identify([Run(run.rig, run.records[:1])])  # imports and FFT plans are not the method's
    started = time.perf_counter()
    result = identify([run])
    return {
        "records": len(run.records),
        "data_seconds": sum(r.samples / r.sample_rate for r in run.records),
        "rows": sum(result.rows.values()),
        "identify_seconds": time.perf_counter() - started,
        "solve_seconds": result.solve_seconds,
    }


def simulation_figures(run: Run, model: Model, repeats: int = 5) -> dict[str, Any]:
    """Return how many times faster than real time the model runs on the run's first record.

    Best of `repeats`, all joints of the record as they were (locked ones held), and the ratio to
    scipy's LSODA at equal accuracy, the same compiled right-hand side behind it.
    """
    signals = condition(run.rig, run.records[0])
    ready, drive, start = compiled(model), drive_of(signals), state_at(signals, 0)
    best, result = np.inf, simulate(ready, drive, start)
    for _ in range(repeats):
        started = time.perf_counter()
        result = simulate(ready, drive, start)
        best = min(best, time.perf_counter() - started)
    seconds = len(drive.u) / drive.rate
    lsoda, difference = _lsoda(ready, drive, start)
    return {
        "simulated_seconds": seconds,
        "wall_seconds": best,
        "times_real_time": seconds / best,
        "evaluations_per_second": result.evaluations / seconds,
        "lsoda_over_own": float(lsoda / best * seconds),
        "piston_difference_to_lsoda_m": difference,
        "failure": result.failure,
    }


def _lsoda(ready: Any, drive: DrivingInput, start: State) -> tuple[float, float]:
    """Return LSODA's wall seconds per simulated second and the largest piston difference [m]."""
    samples = min(len(drive.u), round(2 * drive.rate))
    own = simulate(ready, drive, start, 0, samples)
    rates = rates_of(ready, drive)
    y0 = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    t = np.arange(samples) / drive.rate
    started = time.perf_counter()
    found = solve_ivp(rates, (0.0, t[-1]), y0, "LSODA", t, rtol=1e-7, atol=1e-7)
    spent = time.perf_counter() - started
    N = len(start.q)
    difference = np.abs((found.y[:N].T - own.q)[:, ~drive.locked]).max() * 0.1
    return spent / t[-1], float(difference)
