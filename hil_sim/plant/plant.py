"""The simulated bench: hydraulics, arm, valves and converters, one tick at a time.

Deterministic for (rig, scenario, seed); it does not depend on the division of ticks into calls.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil_sim.effects.base import Tables
from hil_sim.plant import kernel, kernel_loop
from hil_sim.plant.interface import Law
from hil_sim.plant.kernel_data import ATMOSPHERE, LAW, record
from hil_sim.plant.tables import build, ring_length
from hil_sim.scenario.file import Scenario
from hil_sim.scenario.truth import load_machine
from rig.model.rig import Rig
from rig.model.wire.codes import Array, Codes

# Longest integration step [s]. plant_bench.accuracy gives 3e-7 of the pressures' range with it
# (1e-7 at 1/6 ms, 8e-7 at 1/4 ms); the stiffest edge, wide open at an end stop, allows 1/4 ms.
STEP = 2e-4
NOISE_TICKS: Final = 256  # ticks of noise drawn at once, and kept for `rewind`


class Plant:
    """A bench with its state; sample k is taken at time k / rig.sample_rate.

    Raises InputError for a rig without all parameters or a scenario that does not fit it.
    """

    def __init__(self, rig: Rig, scenario: Scenario, seed: int) -> None:
        self.tick = 0
        self._rig = rig
        machine = load_machine(rig, scenario.parameters)
        self._truth = dict(machine.parameters)
        # Streams of one seed: 0 sensor noise, 1 oil temperature; 2 is reserved for drawn scenarios.
        self._noise_rng = np.random.default_rng([seed, 0])
        # Read by the compiled loop: a change acts from the next tick on.
        self.tables = build(rig, machine, scenario, _periods(np.random.default_rng([seed, 1])))
        self._period = 1.0 / rig.sample_rate
        self._substeps = math.ceil(self._period / STEP * (1.0 - 1e-9))
        self._state, self._spool = rest(self.tables)
        self._joints, self._width = len(rig.joints), len(rig.channels)
        self._noise_rows, self._noise_used = np.empty((0, self._width)), 0
        self._work = np.zeros(kernel_loop.work_size(self._joints))
        self._laws: tuple[Law, ...] = ()
        ring = ring_length(self.tables.channels, self._period)
        self._values, self._slopes = np.zeros((ring, self._width)), np.zeros((ring, self._width))
        self._fill_history()
        # Compile (or load) the tick loop now, so that the first block need not wait for it.
        self.advance(0, [Law()] * len(rig.joints))

    def advance(self, ticks: int, laws: Sequence[Law]) -> tuple[Codes, Codes]:
        """Run `ticks` ticks under one law per joint.

        Returns AD codes in the order of rig.channels, (ticks, channels), and the DA codes put out
        at each tick and held until the next, (ticks, joints). A law passed again (the same object)
        keeps its wave: pass a new Law for a new wave. Raises ValueError for a wrong
        number of laws.
        """
        joints = self._joints
        if len(laws) != joints:
            raise ValueError(f"{len(laws)} laws for {joints} joint(s)")
        if len(self._laws) != joints or not all(map(operator.is_, laws, self._laws)):
            self._laws, self._law_table = tuple(laws), _law_table(laws)
        table, waves = self._law_table
        measured = np.empty((ticks, self._width), dtype=np.int64)
        outputs = np.empty((ticks, joints), dtype=np.int64)
        t = self.tables
        kernel_loop.run(
            self.tick,
            self._period,
            self._substeps,
            self._state,
            self._spool,
            self._values,
            self._slopes,
            t.joints,
            t.bench,
            t.inertia,
            t.channels,
            table,
            waves,
            self._next_noise(ticks),
            measured,
            outputs,
            self._work,
        )
        self.tick += ticks
        return measured, outputs

    def mark(self) -> object:
        """Return the state for `rewind`."""
        return self.tick, [array.copy() for array in self._mutable_arrays]

    def rewind(self, mark: Any) -> None:
        """Restore the state of a mark, with the same noise from there on."""
        tick, arrays = mark
        self._noise_used -= self.tick - tick
        self.tick = tick
        for array, values in zip(self._mutable_arrays, arrays, strict=True):
            array[:] = values

    @property
    def _mutable_arrays(self) -> tuple[NDArray[Any], ...]:
        """The arrays that a tick changes in place; of the channels the states of their filters."""
        return self._state, self._spool, self._values, self._slopes, self.tables.channels

    def _next_noise(self, ticks: int) -> Array:
        """Return the noise of the next `ticks` ticks, (ticks, channels).

        The newest noise is kept as long as `rewind` may need it again.
        """
        first, last = self._noise_used, self._noise_used + ticks
        if last > len(self._noise_rows):
            rows = max(NOISE_TICKS, last - len(self._noise_rows))
            drawn = self._noise_rng.standard_normal((rows, self._width))
            keep = max(first - NOISE_TICKS, 0)
            self._noise_rows = np.concatenate([self._noise_rows[keep:], drawn])
            first, last = first - keep, last - keep
        self._noise_used = last
        return self._noise_rows[first:last]

    def truth(self) -> dict[str, float]:
        """Return the true parameters [SI] by the names of rig.model.parameters.

        They are the machine's with the scenario's overrides, without effects such as a payload.
        """
        return dict(self._truth)

    def snapshot(self) -> dict[str, Array]:
        """Return the present true state [SI], for tests and figures; not available over a wire.

        Per joint, (N,): angle, rate, piston, speed, cap_pressure, rod_pressure, spool, opening,
        bristle; of the bench, (): supply_pressure, port_pressure, tank_pressure, oil_temperature.
        """
        n, y, bench = len(self._rig.joints), self._state, record(self.tables.bench)
        joints = self._rig.joints
        q, rate = y[:n].copy(), y[n : 2 * n].copy()
        lever = np.array([j.linkage.jacobian(q[i]) for i, j in enumerate(joints)])
        p = np.array([kernel.pressure(z, bench) for z in y[2 * n : 4 * n]])
        supply = np.array(kernel.pressure(y[5 * n], bench))
        port = np.array(kernel.pressure(y[5 * n + 1], bench)) if bench.line_gain > 0 else supply
        return {
            "angle": q,
            "rate": rate,
            "piston": np.array([j.linkage.piston(q[i]) for i, j in enumerate(joints)]),
            "speed": lever * rate,
            "cap_pressure": p[:n],
            "rod_pressure": p[n:],
            "spool": self._spool[0].copy(),
            "opening": self._spool[2].copy(),
            "bristle": y[4 * n : 5 * n].copy(),
            "supply_pressure": supply,
            "port_pressure": port,
            "tank_pressure": np.array(y[5 * n + 2]),
            "oil_temperature": np.array(kernel_loop.temperature(self.tick * self._period, bench)),
        }

    def _fill_history(self) -> None:
        # Before tick 0 the bench had been at rest, so every earlier sample is the first.
        t, bench, dy = self.tables, record(self.tables.bench), np.zeros_like(self._state)
        heat = kernel_loop.temperature(0.0, bench)
        kernel_loop.sense(
            self._state, dy, self._spool, heat, t.joints, bench, t.channels,
            self._period, self._values[0], self._slopes[0],
        )  # fmt: skip
        self._values[:] = self._values[0]
        self._slopes[:] = 0.0


def _periods(rng: np.random.Generator) -> dict[str, float]:
    return {
        "period_1": float(rng.uniform(500.0, 900.0)),
        "phase_1": float(rng.uniform()),
        "period_2": float(rng.uniform(120.0, 240.0)),
        "phase_2": float(rng.uniform()),
    }


def _law_table(laws: Sequence[Law]) -> tuple[NDArray[np.void], Array]:
    table = np.zeros(len(laws), LAW)
    waves = [np.asarray(law.wave, dtype=np.float64).ravel() for law in laws]
    first = 0
    for row, law, wave in zip(table, laws, waves, strict=True):
        for name in ("gain", "bias", "position_gain", "setpoint", "limit", "start"):
            row[name] = getattr(law, name)
        row["first"], row["period"] = first, len(wave)
        first += len(wave)
    return table, np.concatenate([*waves, np.zeros(1)])


def compression(p: float, bulk: float, trapped: float) -> float:
    """Return the compression z of oil at gauge pressure p [Pa]; the inverse of kernel.pressure."""
    absolute = p + ATMOSPHERE
    return absolute / bulk - trapped * bulk / (4.0 * absolute)


def rest(tables: Tables) -> tuple[Array, Array]:
    """Return (state, spools) at rest: mid-stroke, closed valves, chambers balancing the load.

    The pressures of a cylinder add up to the supply's where both then stay above 0.1 of it.
    """
    rig, bench = tables.rig, record(tables.bench)
    n, bulk = len(rig.joints), 2.0 * bench.half_bulk
    state, spool = np.zeros(5 * n + 3), np.zeros((3, n))
    q = np.array([float(j.linkage.angle(0.0)) for j in rig.joints])
    theta = np.cumsum(q) + math.atan2(bench.sin_slope, bench.cos_slope)
    ps, floor = rig.supply.pressure, 0.1 * rig.supply.pressure
    for i, joint in enumerate(rig.joints):
        row, cylinder = tables.joints[i], joint.cylinder
        twist = q[i] - row["spring_rest"]
        load = float(np.sum(tables.joints["weight"][i:] * np.sin(theta[i:])))
        load += row["spring"] * twist * (1.0 + row["spring_hardening"] * twist**2)
        load -= row["torque_offset"]
        force = load / float(joint.linkage.jacobian(q[i]))
        cap = (force + cylinder.rod_area * ps) / (cylinder.cap_area + cylinder.rod_area)
        cap = max(cap, floor, (force + cylinder.rod_area * floor) / cylinder.cap_area)
        rod = (cylinder.cap_area * cap - force) / cylinder.rod_area
        state[i] = q[i]
        state[2 * n + i] = compression(cap, bulk, bench.trapped)
        state[3 * n + i] = compression(rod, bulk, bench.trapped)
    state[5 * n : 5 * n + 2] = compression(ps, bulk, bench.trapped)
    state[5 * n + 2] = bench.tank_pressure
    spool[2] = -tables.joints["null"]
    return state, spool
