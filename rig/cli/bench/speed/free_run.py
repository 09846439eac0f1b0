"""Times of a free run: by the model, by the same equations written by hand, odeint and CVODES."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import odeint as scipy_odeint

from analysis.simulation.equations import call_rates
from analysis.simulation.model import Model, nominal_model
from analysis.simulation.settings import SIMULATION
from analysis.simulation.simulate import Compiled, DrivingInput, State, compiled, simulate
from analysis.simulation.synthetic import multisine
from analysis.simulation.twin import holding_state
from analysis.terms import baseline_of
from analysis.terms.base import Used
from rig.cli.bench.figure import REPEATS, processor_times
from rig.cli.bench.speed import reference_solvers
from rig.model.rig import Rig

Array = NDArray[np.float64]

SPOOL_RMS: Final = 0.006  # [V] moves both joints by some centimetres
SCALE: Final = np.array([1.0, 1.0, 1.0, 1.0, 1e6, 1e6, 1e6, 1e6])  # rad, rad/s, Pa
# A quarter of a decade apart: with coarser steps a reference would solve more exactly than needed.
TOLERANCES: Final = tuple(10.0 ** (-exponent / 4.0) for exponent in range(16, 41))


def free_run_times(rig: Rig, repeats: int = REPEATS) -> dict[str, Any]:
    """Return the processor times of a free run of 10 s with both joints moving, by four solvers.

    `bramah`: this program. `hand`: the same equations and steps written by hand. `odeint`: scipy's,
    with the same compiled right-hand side. `cvodes`: with generated C code (extra `bench`). The
    last two run at the loosest tolerance at which no state is less accurate (largest error over its
    range, against LSODA at rtol 1e-12). All return states, piston positions and piston velocities.
    """
    model, drive, start = both_moving(rig)
    ready = compiled(model)
    simulation = simulate(ready, drive, start)
    p = reference_solvers.constants(rig, model.values)
    y0 = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    angle, pressure = SIMULATION.angle_tolerance, SIMULATION.pressure_tolerance
    atol = np.repeat([angle, ready.rate_tolerance, pressure, pressure], 2)
    out = np.zeros((len(drive.u), 12))

    def by_hand() -> None:
        reference_solvers.free_run(
            y0, drive.u, drive.p_s, drive.rate, p, SIMULATION.relative_tolerance, atol, out
        )

    by_hand()
    rates, t = _compiled_callback(ready, drive), np.arange(len(drive.u)) / drive.rate

    def odeint(rtol: float) -> Array:
        return np.asarray(scipy_odeint(rates, y0, t, tfirst=True, rtol=rtol, atol=rtol * SCALE))

    true = odeint(1e-12)
    size = np.ptp(true, axis=0)

    def error(states: Array) -> float:
        return float((np.abs(states - true).max(axis=0) / size).max())

    simulated = np.hstack((simulation.q, simulation.qd, simulation.p_cap, simulation.p_rod))
    exact = error(simulated)
    rtol = next(r for r in TOLERANCES if error(odeint(r)) <= exact)
    errors = {"odeint_error": error(odeint(rtol))}
    links = [joint.linkage for joint in rig.joints]

    def pistons(states: Array) -> None:
        for i, link in enumerate(links):
            link.piston(states[:, i])
            _ = link.jacobian(states[:, i]) * states[:, 2 + i]

    works: dict[str, Callable[[], object]] = {
        "bramah": lambda: simulate(ready, drive, start),
        "hand": by_hand,
        "odeint": lambda: pistons(odeint(rtol)),
    }
    with TemporaryDirectory(prefix="bramah-cvodes-") as folder:
        if find_spec("casadi") and find_spec("ziglang"):  # the extra `bench`
            inputs = np.column_stack((drive.u, drive.p_s))
            solver = reference_solvers.cvodes_solver
            interpreted = solver(p, inputs, drive.rate, SCALE, None)
            loosest = next(r for r in TOLERANCES if error(interpreted(r, y0)()) <= exact)
            by_cvodes = solver(p, inputs, drive.rate, SCALE, Path(folder))(loosest, y0)
            errors["cvodes_error"] = error(by_cvodes())
            works["cvodes"] = lambda: pistons(by_cvodes())
        times = processor_times(works, repeats)
    return {
        **times,
        "times_real_time": float(t[-1] / times["bramah"].least),
        "error": exact,
        **errors,
        "difference_to_hand": float(np.abs(out[:, :2] - simulation.q).max()),
        "failure": simulation.failure,
    }


def _compiled_callback(ready: Compiled, drive: DrivingInput) -> Callable[[float, Array], Array]:
    """Return dy/dt(t, y) as one compiled function: the Python overhead is then odeint's alone."""
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

    # The callback keeps the arrays alive.
    rates.held = arrays
    return rates  # type: ignore[no-any-return]


def both_moving(rig: Rig) -> tuple[Model, DrivingInput, State]:
    """Return the nominal model, 10 s of spool signals that move all joints, and a state at rest."""
    model = nominal_model(rig, tuple(Used(term) for term in baseline_of(rig)))
    start = holding_state(rig, model, np.zeros(len(rig.joints)))
    rng, n = np.random.default_rng(0), round(10.0 * rig.sample_rate) + 1
    wave = multisine(rng, rig.sample_rate, 10.0, 4.0)[0]
    shifts = [k * len(wave) // 3 for k in range(len(rig.joints))]
    spools = np.column_stack([SPOOL_RMS * np.resize(np.roll(wave, k), n) for k in shifts])
    still = np.zeros((n, len(rig.joints)))
    drive = DrivingInput(
        rig.sample_rate, spools, np.full(n, rig.supply.pressure), np.full(n, rig.oil.temperature),
        np.zeros(len(rig.joints), dtype=bool), still, still, still,
    )  # fmt: skip
    return model, drive, start
