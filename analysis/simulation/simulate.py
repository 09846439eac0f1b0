"""Simulation of the identified model: driven by the spool, locked joints held."""

from __future__ import annotations

import enum
import functools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.signals.conditioning import Signals
from analysis.simulation import compiled_sources, fused, interpreted
from analysis.simulation import equations as eq
from analysis.simulation.integrator import integrate
from analysis.simulation.model import Array, Model
from analysis.simulation.settings import SIMULATION
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.terms.sine_cosine import sine_cosine
from analysis.terms.specialise import NotSpecialisable
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)

_REASONS = {
    eq.LEFT_STROKE: "a piston went half a stroke past its end",
    eq.NOT_FINITE: "the state diverged",
    eq.STEP_TOO_SMALL: "the step needed fell below 0.1 us (the state diverged)",
    eq.BAD_INERTIA: "the inertia matrix is not positive definite",
}


@dataclass(frozen=True)
class DrivingInput:
    """Inputs of a simulation: samples (n,) or (n, N) at `rate`.

    `q qd qdd` are used for the joints that `locked` (N,) marks.
    """

    rate: float
    u: Array
    p_s: Array
    temperature: Array
    locked: NDArray[np.bool_]
    q: Array
    qd: Array
    qdd: Array

    @functools.cached_property
    def inputs(self) -> Array:
        """Return all inputs in the right-hand side's layout, (n, 3 + 4 N)."""
        time = np.arange(len(self.u)) / self.rate
        parts = (self.p_s, self.temperature, self.u, self.q, self.qd, self.qdd, time)
        return np.ascontiguousarray(np.column_stack(parts))


@dataclass(frozen=True)
class State:
    """State at one instant: q [rad], qd [rad/s], p_cap, p_rod [Pa], each (N,).

    `hidden` (h,) are the terms' hidden states in the model's order (see `hidden_paths`); if empty,
    all are zero, as after a long rest.
    """

    q: Array
    qd: Array
    p_cap: Array
    p_rod: Array
    hidden: Array | None = None


@dataclass(frozen=True)
class Simulation:
    """A simulated record: arrays (n, N), held at their last value after a failure.

    `failure` states why and when the simulation failed ('' if it did not); `filled` samples are
    valid; `outside` counts samples with a chamber pressure outside [0, p_s], where the model's
    orifices have no real root and the signed root was used.
    """

    rate: float
    q: Array
    qd: Array
    p_cap: Array
    p_rod: Array
    piston: Array
    speed: Array
    failure: str
    filled: int
    outside: int
    evaluations: int
    electric: bool = False

    def channels(self) -> dict[str, Array]:
        """Return piston and chamber pressures (electric: position) by channel name, each (n,)."""
        out = {}
        for i in range(self.q.shape[1]):
            if self.electric:
                out[ch.channel(ch.POSITION, i + 1)] = self.q[:, i]
                continue
            out[ch.channel(ch.PISTON, i + 1)] = self.piston[:, i]
            out[ch.channel(ch.CAP, i + 1)] = self.p_cap[:, i]
            out[ch.channel(ch.ROD, i + 1)] = self.p_rod[:, i]
        return out


def constant_supply(
    rig: Rig, rate: float, spool: Array, locked: NDArray[np.bool_], q: Array
) -> DrivingInput:
    """Return the drive by spools (n, N) [V] at nominal supply and oil, locked joints at q (N,)."""
    n, still = len(spool), np.zeros(spool.shape)
    return DrivingInput(
        rate, spool, np.full(n, rig.supply.pressure), np.full(n, rig.oil.temperature), locked,
        np.tile(q, (n, 1)), still, still,
    )  # fmt: skip


def drive_of(signals: Signals) -> DrivingInput:
    """Return the drive of a record: its measured spool, supply, and locked joints' motion."""
    return DrivingInput(
        signals.rate, signals.u, signals.p_s, signals.temperature, ~signals.excited,
        signals.q, signals.qd, signals.qdd,
    )  # fmt: skip


@dataclass(frozen=True)
class Compiled:
    """A model in the integrator's arrays: its right-hand side `rates` and the arguments of that.

    `hidden` states follow the 4 N of the joints; `fused` states whether `rates` was generated for
    this set of terms.
    """

    rates: Any
    context: NDArray[np.int64]
    par: Array
    geometry: Array
    hidden: int
    rate_tolerance: float
    fused: bool

    @property
    def address(self) -> int:
        """Machine address of the right-hand side."""
        return int(self.rates.address)

    def work(self) -> Array:
        """Return workspace for one thread to evaluate the right-hand side in."""
        return np.zeros(interpreted.work_size(len(self.geometry)))


class Effort(enum.Enum):
    """How often a model will be simulated, which decides whether it is compiled."""

    ONCE = "a few records"
    FIT = "hundreds of records"


def compiled(model: Model, effort: Effort = Effort.ONCE) -> Compiled:
    """Return a model in the integrator's layout; raises InputError for unidentified parameters.

    A generated right-hand side is used if it is on disk; it is generated where all terms are of the
    rig's baseline, and for a fit. Otherwise terms are called one by one. The results are equal.
    """
    missing = [name for name, p in model.parameters.items() if not p.identified]
    if missing:
        raise InputError(
            f"the model cannot be simulated: {' '.join(missing)} not identified; identify again "
            "with records that excite them"
        )
    values = model.values
    packed = [u.term.pack(model.rig, values, u.shape) for u in model.terms]
    hidden = [u.term.hidden(model.rig) for u in model.terms]
    geometry = _geometry(model.rig)
    rates = _fused(model, packed, hidden, geometry, effort)
    no_terms = np.zeros(1, dtype=np.int64)
    return Compiled(
        rates or interpreted.compiled_rates(),
        no_terms if rates else interpreted.context(len(geometry), model.terms, packed, hidden),
        np.concatenate(packed),
        geometry,
        sum(hidden),
        min(u.term.tolerance(u.shape) for u in model.terms),
        rates is not None,
    )


def _fused(
    model: Model, packed: Sequence[Array], hidden: Sequence[int], geometry: Array, effort: Effort
) -> Any | None:
    """Return the compiled right-hand side of the model's set of terms, None if there is none."""
    electric = [bool(gain != 0.0) for gain in geometry[:, eq.GAIN]]
    try:
        source = fused.source_of(model.terms, packed, hidden, electric)
    except NotSpecialisable as reason:
        log.info("the equations are evaluated term by term: %s", reason)
        return None
    compiled_source = compiled_sources.stored(source)
    only_baseline = {u.term.name for u in model.terms} <= {t.name for t in baseline_of(model.rig)}
    if compiled_source is None and (only_baseline or effort is Effort.FIT):
        names = " ".join(dict.fromkeys(u.term.name for u in model.terms))
        return compiled_sources.compiled_now(source, f"{len(electric)} joint(s): {names}")
    return compiled_source


@functools.lru_cache(maxsize=16)
def _geometry_cached(rows: tuple[tuple[float, ...], ...]) -> Array:
    return np.array(rows)


def _geometry(rig: Rig) -> Array:
    if rig.electric:
        rows = [[0.0] * 10 for _ in rig.joints]
        for row, gain in zip(rows, rig.drive_gains, strict=True):
            row[eq.GAIN] = gain
        rows[0][eq.OFFSET] = rig.base_angle
        return _geometry_cached(tuple(map(tuple, rows)))
    return _geometry_cached(
        tuple(
            (
                j.linkage.base_pin, j.linkage.arm_pin, j.linkage.mid_length, j.linkage.offset,
                j.cylinder.cap_area, j.cylinder.rod_area,
                j.cylinder.cap_pipe_volume, j.cylinder.rod_pipe_volume, j.cylinder.stroke, 0.0,
            )
            for j in rig.joints
        )
    )  # fmt: skip


def simulate(
    model: Model | Compiled,
    drive: DrivingInput,
    start: State,
    first: int = 0,
    samples: int | None = None,
) -> Simulation:
    """Simulate `samples` samples of the drive from sample `first` on, starting from `start`.

    Pass the result of `compiled` instead of a model for repeated simulations. A failure ends the
    simulation and is reported in `failure`, with the last state held.
    """
    ready = compiled(model) if isinstance(model, Model) else model
    total = len(drive.u)
    samples = total - first if samples is None else samples
    N = drive.u.shape[1]
    hidden = ready.hidden
    ys = np.empty((samples, 4 * N + hidden))
    ys[0] = 0.0
    ys[0, : 4 * N] = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    if start.hidden is not None:
        ys[0, 4 * N :] = start.hidden
    inputs = drive.inputs[first : first + samples]
    angle, pressure = SIMULATION.angle_tolerance, SIMULATION.pressure_tolerance
    atol = np.repeat(
        [angle, ready.rate_tolerance, pressure, pressure, SIMULATION.state_tolerance],
        [N, N, N, N, hidden],
    )
    status, filled, evaluations = integrate(
        ready.address, ready.context, ready.par, ready.geometry, ready.work(),
        inputs, drive.rate, drive.locked, SIMULATION.relative_tolerance, atol, ys,
    )  # fmt: skip
    failure = ""
    if status != eq.OK:
        failure = f"{_REASONS[status]} {filled / drive.rate:.3f} s after the start"
    q, qd, cap, rod, piston, speed = np.empty((6, samples, N))
    electric = bool((ready.geometry[:, eq.GAIN] != 0.0).all())
    outside = _output(
        ready.geometry, inputs, drive.locked, ys, filled, electric, q, qd, cap, rod, piston, speed
    )
    if electric:
        piston, speed = q, qd
    return Simulation(
        drive.rate, q, qd, cap, rod, piston, speed, failure, int(filled), int(outside),
        int(evaluations), electric,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _output(geometry, inputs, locked, ys, filled, electric, q, qd, cap, rod, piston, speed):  # type: ignore[no-untyped-def]
    """Fill all output (n, N) from the states ys (n, size), the last one of `filled` being held.

    Return how many samples have a pressure outside [0, p_s]; none where the joints are electric.
    """
    n, N = q.shape
    ys[filled:] = ys[filled - 1]
    count = 0
    for k in range(n):
        is_outside, p_s = False, inputs[k, 0]
        for i in range(N):
            q[k, i], qd[k, i] = ys[k, i], ys[k, N + i]
            a, b = ys[k, 2 * N + i], ys[k, 3 * N + i]
            cap[k, i], rod[k, i] = a, b
            is_outside |= (not locked[i]) & ((a < 0.0) | (a > p_s) | (b < 0.0) | (b > p_s))
        count += is_outside & (k < filled)
    for i in range(N):
        if locked[i]:
            q[:, i], qd[:, i] = inputs[:, 2 + N + i], inputs[:, 2 + 2 * N + i]
        if electric:
            continue
        position, slope = _linkage(q[:, i].copy(), geometry[i])
        for k in range(n):
            piston[k, i], speed[k, i] = position[k], slope[k] * qd[k, i]
    return 0 if electric else count


@njit(cache=True, error_model="numpy", nogil=True)
def _linkage(q, geometry):  # type: ignore[no-untyped-def]
    """Return a piston's position [m] and ds/dq [m] at angles q (n,) [rad]."""
    a, c, mid = geometry[eq.PIN_A], geometry[eq.PIN_C], geometry[eq.MID]
    position, slope = np.empty((2, len(q)))
    for k in range(len(q)):
        sine, cosine = sine_cosine(q[k] + geometry[eq.OFFSET])
        length = math.sqrt(a * a + c * c - 2.0 * a * c * cosine)
        position[k], slope[k] = length - mid, a * c * sine / length
    return position, slope


def state_at(signals: Signals, sample: int) -> State:
    """Return the measured state at one sample of the filtered signals."""
    return State(
        signals.q[sample], signals.qd[sample], signals.p_cap[sample], signals.p_rod[sample]
    )


def sensor_corrected(rig: Rig, terms: Sequence[Used], signals: Signals) -> Signals:
    """Return signals corrected for the terms' sensor effects; other terms prepare in simulation."""
    for used in terms:
        if not used.term.prepares:
            signals = used.term.prepare(rig, signals, used.shape)
    return signals


def hidden_paths(model: Model, signals: Signals) -> Array:
    """Return the terms' hidden states (n, h) along measured signals, in the model's order.

    Every term sees the signals as prepared by those before it, as in simulation. `signals` must be
    corrected for sensor effects.
    """
    values, out = model.values, [np.zeros((len(signals.t), 0))]
    stateful = [k for k, u in enumerate(model.terms) if u.term.hidden(model.rig)]
    for used in model.terms[: stateful[-1] + 1 if stateful else 0]:
        out.append(used.term.hidden_path(model.rig, signals, values, used.shape))
        if used.term.prepares:
            signals = used.term.prepare(model.rig, signals, used.shape)
    return np.concatenate(out, axis=1)
