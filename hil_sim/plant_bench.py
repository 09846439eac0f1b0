"""The plant's own figures: how exact its fixed step is, and how fast."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from hil_sim import kernel
from hil_sim.kernel_data import record
from hil_sim.plant import Law, Plant
from hil_sim.scenario import Scenario
from rig.model.codes import Array, decode_output
from rig.model.rig import Rig

PEAK = 1.6  # of the command, either joint [V]
LINES = (1, 3, 5, 7, 9, 13, 19)  # odd multiples of 0.5 Hz


def hard_waves(rig: Rig, seed: int = 1) -> list[Array]:
    """Return one 2 s multisine per joint [V], 0.5 to 9.5 Hz with random phases, (period,) each."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(2.0 * rig.sample_rate)) / rig.sample_rate
    waves = []
    for _ in rig.joints:
        phases = rng.uniform(0.0, 2.0 * math.pi, len(LINES))
        lines = zip(LINES, phases, strict=True)
        wave = sum(np.sin(math.pi * k * t + phase) for k, phase in lines)
        waves.append(PEAK * np.asarray(wave) / np.max(np.abs(wave)))
    return waves


def hard_laws(rig: Rig) -> list[Law]:
    """Return the laws that play `hard_waves` on all joints at once, open loop."""
    return [
        Law(wave=wave, gain=1.0, limit=joint.limits.command)
        for wave, joint in zip(hard_waves(rig), rig.joints, strict=True)
    ]


def signals(plant: Plant) -> Array:
    """Return angles [rad], then all pressures [Pa] of the plant now, shape (3 N + 1,)."""
    now = plant.snapshot()
    names = ("angle", "cap_pressure", "rod_pressure", "supply_pressure")
    return np.concatenate([np.atleast_1d(now[name]) for name in names])


class Reference:
    """The same equations by scipy, tick by tick so that held inputs do not break its order."""

    def __init__(self, plant: Plant) -> None:
        self.n = len(plant._rig.joints)
        self.tables, self.period = plant._tables, plant._period
        self.bench = record(self.tables.bench)
        self.y = np.concatenate([plant._state, plant._spool.ravel()])
        self.tick = plant.tick
        n = self.n
        # Errors are judged against 1 rad and 7 MPa; z is a pressure over the bulk modulus.
        self.scale = np.concatenate(
            [np.ones(2 * n), np.full(2 * n, 0.03), np.full(n, 1e-4), [0.03, 0.03, 1e5], np.ones(3 * n)]
        )

    def rates(self, target: Array, warmth: float) -> Callable[[float, Array], Array]:
        """Return the right-hand side of the whole state under held spool targets."""
        n, size, t = self.n, 5 * self.n + 3, self.tables
        work = np.zeros((n + 4, n))

        def f(_: float, y: Array) -> Array:
            out = np.empty_like(y)
            u, w, x = y[size : size + n], y[size + n : size + 2 * n], y[size + 2 * n :]
            kernel.rates(y[:size], u - t.joints["null"], warmth, t.joints, self.bench, t.inertia,
                         work, out[:size])
            for i in range(n):
                rates = kernel.spool_rates(u[i], w[i], x[i], target[i], t.joints[i])
                out[size + i], out[size + n + i], out[size + 2 * n + i] = rates
            return out

        return f

    def advance(self, target: Array, **options: Any) -> None:
        """Integrate one tick."""
        heat = kernel.temperature(self.tick * self.period, self.bench)
        warmth = 1.0 + self.bench.bulk_temperature * (heat - self.bench.temperature)
        rtol = options.pop("rtol")
        result = solve_ivp(
            self.rates(target, warmth), (0.0, self.period), self.y, rtol=rtol,
            atol=rtol * self.scale, **options,
        )  # fmt: skip
        self.y = result.y[:, -1]
        self.tick += 1

    def signals(self) -> Array:
        """Return what `signals` does, of the reference."""
        n = self.n
        z = [*self.y[2 * n : 4 * n], self.y[5 * n]]
        return np.concatenate([self.y[:n], [kernel.pressure(v, self.bench) for v in z]])
