"""The analysis' part of the performance figures, as dicts; nothing here prints."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import odeint as scipy_odeint

from analysis.identify.identify import identify
from analysis.simulation.equations import call_rates
from analysis.simulation.model import Model, nominal_model
from analysis.simulation.settings import SIMULATION
from analysis.simulation.simulate import (
    Compiled,
    DrivingInput,
    State,
    compiled,
    simulate,
)
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.simulation.twin import holding_state
from analysis.terms import baseline_of
from analysis.terms.base import Used
from rig.cli.bench import hand_fused
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]

SPOOL_RMS = 0.006  # [V] moves both joints by some centimetres
SCALE = np.array([1.0, 1.0, 1.0, 1.0, 1e6, 1e6, 1e6, 1e6])  # rad, rad/s, Pa: odeint's tolerances


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


def simulation_figures(rig: Rig, repeats: int = 5) -> dict[str, Any]:
    """Return what a free run of 10 s with both joints moving takes, beside what it is held against.

    Processor milliseconds, least and median of `repeats`, of this program, of the same equations
    and steps written by hand (`rig.cli.bench.hand_fused`), and of scipy's odeint over the same
    compiled right-hand side at the loosest tolerance that is no less exact.
    """
    model, drive, start = _both_moving(rig)
    ready = compiled(model)
    simulated = simulate(ready, drive, start)
    own = _spent(lambda: simulate(ready, drive, start), repeats)
    p = hand_fused.constants(rig, model.values)
    y0 = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    angle, pressure = SIMULATION.angle_tolerance, SIMULATION.pressure_tolerance
    atol = np.repeat([angle, ready.rate_tolerance, pressure, pressure], 2)
    out = np.zeros((len(drive.u), 12))

    def by_hand() -> None:
        hand_fused.free_run(
            y0, drive.u, drive.p_s, drive.rate, p, SIMULATION.relative_tolerance, atol, out
        )

    by_hand()
    hand = _spent(by_hand, repeats)
    rates, t = _compiled_callback(ready, drive), np.arange(len(drive.u)) / drive.rate

    def odeint(rtol: float) -> Array:
        return np.asarray(scipy_odeint(rates, y0, t, tfirst=True, rtol=rtol, atol=rtol * SCALE))

    true = odeint(1e-12)

    def error(q: Array) -> float:
        return float(np.abs(q - true[:, :2]).max())

    exact = error(simulated.q)
    rtol = next(
        r for r in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10) if error(odeint(r)[:, :2]) <= exact
    )
    other = _spent(lambda: odeint(rtol), repeats)
    return {
        "simulated_seconds": t[-1],
        "times_real_time": float(t[-1] / own[0]),
        "own": own,
        "hand": hand,
        "odeint": other,
        "odeint_rtol": rtol,
        "angle_error": exact,
        "difference_to_hand": float(np.abs(out[:, :2] - simulated.q).max()),
        "failure": simulated.failure,
    }


def _compiled_callback(ready: Compiled, drive: DrivingInput) -> Callable[[float, Array], Array]:
    """Return dy/dt(t, y) as one compiled call of two arguments: Python's share is odeint's own."""
    work, address, n, rate = ready.work(), ready.address, len(drive.u), drive.rate
    arrays = (drive.inputs, drive.locked, ready.geometry, ready.par, ready.context, work)
    inputs, locked, geometry, par, context, room = (int(a.ctypes.data) for a in arrays)

    @njit(error_model="numpy")
    def rates(t, y):  # type: ignore[no-untyped-def]
        dy = np.empty_like(y)
        call_rates(
            address, t, y.ctypes.data, dy.ctypes.data, inputs, n, rate, locked, geometry, par,
            context, room,
        )  # fmt: skip
        return dy

    # The arrays live as long as whoever calls.
    rates.held = arrays
    return rates  # type: ignore[no-any-return]


def _spent(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the least and the median processor time [s] of some repeats."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times), float(np.median(times))


def _both_moving(rig: Rig) -> tuple[Model, DrivingInput, State]:
    """Return the nominal model, 10 s of a spool that moves both joints, and a state at rest."""
    model = nominal_model(rig, tuple(Used(term) for term in baseline_of(rig)))
    start = holding_state(rig, model, np.zeros(len(rig.joints)))
    rng, n = np.random.default_rng(0), round(10.0 * rig.sample_rate) + 1
    wave = multisine(rng, rig.sample_rate, 10.0, 4.0)[0]
    both = [SPOOL_RMS * np.resize(np.roll(wave, shift), n) for shift in (0, len(wave) // 3)]
    still = np.zeros((n, len(rig.joints)))
    drive = DrivingInput(
        rig.sample_rate, np.column_stack(both), np.full(n, rig.supply.pressure),
        np.full(n, rig.oil.temperature), np.zeros(len(rig.joints), dtype=bool), still, still, still,
    )  # fmt: skip
    return model, drive, start
