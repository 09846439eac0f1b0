"""Accuracy and speed of the simulated plant with its fixed step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hil_sim.plant import kernel, kernel_loop
from hil_sim.plant.interface import Law
from hil_sim.plant.kernel_data import record
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.model.rig import Rig
from rig.model.wire.codes import Array, decode_output
from rig.runs.rigs import load_rig

PEAK = 1.6  # amplitude of the command of each joint [V]
LINES = (1, 3, 5, 7, 9, 13, 19)  # odd multiples of 0.5 Hz


def hard_laws(rig: Rig) -> list[Law]:
    """Return laws that play a 2 s multisine [V], 0.5 to 9.5 Hz, on all joints at once, open loop.

    Each joint has its own random phases.
    """
    rng = np.random.default_rng(1)
    t = np.arange(round(2.0 * rig.sample_rate)) / rig.sample_rate
    laws = []
    for joint in rig.joints:
        phases = rng.uniform(0.0, 2.0 * math.pi, len(LINES))
        lines = zip(LINES, phases, strict=True)
        wave = sum(np.sin(math.pi * k * t + phase) for k, phase in lines)
        scaled = PEAK * np.asarray(wave) / np.max(np.abs(wave))
        laws.append(Law(wave=scaled, gain=1.0, limit=joint.limits.command))
    return laws


def signals(plant: Plant) -> Array:
    """Return the plant's angles [rad], then its pressures [Pa], shape (3 N + 1,)."""
    now = plant.snapshot()
    names = ("angle", "cap_pressure", "rod_pressure", "supply_pressure")
    return np.concatenate([np.atleast_1d(now[name]) for name in names])


class Reference:
    """The same equations solved by scipy, per tick: within a call the input must be constant."""

    def __init__(self, plant: Plant) -> None:
        self.n = len(plant._rig.joints)
        self.tables, self.period = plant.tables, plant._period
        self.bench = record(self.tables.bench)
        self.y = np.concatenate([plant._state, plant._spool.ravel()])
        self.tick = plant.tick
        n = self.n
        # Scales of the tolerances: 1 rad and 7 MPa; z is a pressure divided by the bulk modulus.
        self.scale = np.concatenate(
            [
                np.ones(2 * n),
                np.full(2 * n, 0.03),
                np.full(n, 1e-4),
                [0.03, 0.03, 1e5],
                np.ones(3 * n),
            ]
        )

    def rates(self, target: Array, bulk_ratio: float) -> Callable[[float, Array], Array]:
        """Return the right-hand side of the whole state for constant spool targets."""
        n, size, t = self.n, 5 * self.n + 3, self.tables
        work = np.zeros((n + 4, n))

        def f(_: float, y: Array) -> Array:
            out = np.empty_like(y)
            u, w, x = y[size : size + n], y[size + n : size + 2 * n], y[size + 2 * n :]
            kernel.rates(
                y[:size],
                u - t.joints["null"],
                bulk_ratio,
                t.joints,
                self.bench,
                t.inertia,
                work,
                out[:size],
            )
            for i in range(n):
                rates = kernel_loop.spool_rates(u[i], w[i], x[i], target[i], t.joints[i])
                out[size + i], out[size + n + i], out[size + 2 * n + i] = rates
            return out

        return f

    def advance(self, target: Array, **options: Any) -> None:
        """Integrate one tick."""
        T_oil = kernel_loop.temperature(self.tick * self.period, self.bench)
        bulk_ratio = 1.0 + self.bench.bulk_temperature * (T_oil - self.bench.temperature)
        rtol = options.pop("rtol")
        result = solve_ivp(
            self.rates(target, bulk_ratio), (0.0, self.period), self.y, rtol=rtol,
            atol=rtol * self.scale, **options,
        )  # fmt: skip
        self.y = result.y[:, -1]
        self.tick += 1

    def signals(self) -> Array:
        """Return angles [rad], then all pressures [Pa], shape (3 N + 1,)."""
        n = self.n
        z = [*self.y[2 * n : 4 * n], self.y[5 * n]]
        return np.concatenate([self.y[:n], [kernel.pressure(v, self.bench) for v in z]])


def spool_targets(rig: Rig, outputs: NDArray[np.int64]) -> Array:
    """Return the spool targets [V] of DA codes, both (ticks, joints)."""
    columns = [
        np.clip(
            decode_output(outputs[:, i], j.valve.command_range, j.valve.command_bits)
            * j.valve.spool_gain,
            -j.valve.spool_stroke,
            j.valve.spool_stroke,
        )
        for i, j in enumerate(rig.joints)
    ]
    return np.stack(columns, axis=1)


def reference_run(rig: Rig, targets: Array, **options: Any) -> tuple[Array, float]:
    """Integrate `targets` (ticks, joints) from rest: (signals per tick, processor time [s])."""
    reference = Reference(Plant(rig, Scenario(), 1))
    rows = []
    start = time.process_time()
    for target in targets:
        reference.advance(target, **options)
        rows.append(reference.signals())
    return np.stack(rows), time.process_time() - start


def plant_run(rig: Rig, ticks: int) -> tuple[Array, Array]:
    """Run the plant with `hard_laws`; return (signals per tick, spool targets)."""
    plant, laws, rows, codes = Plant(rig, Scenario(), 1), hard_laws(rig), [], []
    for _ in range(ticks):
        codes.append(plant.advance(1, laws)[1])
        rows.append(signals(plant))
    return np.stack(rows), spool_targets(rig, np.concatenate(codes))


def errors(states: Array, true: Array, joints: int) -> dict[str, float]:
    """Return the largest errors of angles and pressures, each relative to its signal's range."""
    relative = np.max(np.abs(states - true), axis=0) / np.ptp(true, axis=0)
    return {
        "angle_error": float(np.max(relative[:joints])),
        "pressure_error": float(np.max(relative[joints:])),
    }


def accuracy(seconds: float = 1.0) -> dict[str, float]:
    """Return the plant's errors against scipy (DOP853, rtol 1e-10) under `hard_laws`.

    Keys: angle_error, pressure_error (relative to each signal's range).
    """
    rig = load_rig("shinshu-2dof")
    simulated, targets = plant_run(rig, round(seconds * rig.sample_rate))
    true, _ = reference_run(rig, targets, method="DOP853", rtol=1e-10)
    return errors(simulated, true, len(rig.joints))


def speed(seconds: float = 5.0) -> dict[str, float]:
    """Return the plant's speed on one core as a multiple of real time, with converters and noise.

    Keys: real_time_ratio; lsoda_ratio, the time of scipy's LSODA divided by the plant's for the
    same input at the loosest of several tolerances at which it is as accurate; plant_error and
    lsoda_error, the largest errors.
    """
    rig = load_rig("shinshu-2dof")
    laws, ticks = hard_laws(rig), round(seconds * rig.sample_rate)
    cost = math.inf  # [s] of processor time per simulated second
    for _ in range(3):  # the best of three, to exclude the load of other programs
        plant = Plant(rig, Scenario(), 1)
        start = time.process_time()
        plant.advance(ticks, laws)
        cost = min(cost, (time.process_time() - start) / seconds)
    part = 0.3
    simulated, targets = plant_run(rig, round(part * rig.sample_rate))
    true, _ = reference_run(rig, targets, method="DOP853", rtol=1e-11)
    plant_error = max(errors(simulated, true, len(rig.joints)).values())
    for rtol in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        rough, lsoda = reference_run(rig, targets, method="LSODA", rtol=rtol)
        lsoda_error = max(errors(rough, true, len(rig.joints)).values())
        if lsoda_error <= plant_error:
            break
    return {
        "real_time_ratio": 1.0 / cost,
        "lsoda_ratio": lsoda / part / cost,
        "lsoda_error": lsoda_error,
        "plant_error": plant_error,
    }
