"""Run the identified model: driven by a spool, locked joints held, failures said aloud."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.signals.conditioning import Signals
from analysis.simulation import integrator
from analysis.simulation.model import Model
from analysis.terms.base import OUT_ROWS, X_ROWS, Used
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.rig import Rig

Array = NDArray[np.float64]

RTOL = 1e-6
ATOL_ANGLE, ATOL_PRESSURE, ATOL_HIDDEN = 1e-7, 10.0, 1e-8  # rad, Pa; of rates the terms say
_REASONS = {
    integrator.LEFT_STROKE: "a piston went half a stroke past its end",
    integrator.NOT_FINITE: "the state diverged",
    integrator.STEP_TOO_SMALL: "the step needed fell below 0.1 us (the state diverged)",
    integrator.BAD_INERTIA: "the inertia matrix is not positive definite",
}


@dataclass(frozen=True)
class DrivingInput:
    """What drives a simulation: samples (n,) or (n, N) at `rate`.

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


@dataclass(frozen=True)
class State:
    """State at one instant: q [rad], qd [rad/s], p_cap, p_rod [Pa], each (N,).

    `hidden` (h,) are the terms' own states in the model's order (see `hidden_paths`); none of them
    given means all at zero, as after a long rest.
    """

    q: Array
    qd: Array
    p_cap: Array
    p_rod: Array
    hidden: Array | None = None


@dataclass(frozen=True)
class Simulation:
    """A simulated stretch: arrays (n, N), held at their last value after a failure.

    `failure` says why and when the state ceased to exist ('' if it did not); `filled` samples are
    real; `outside` counts samples with a chamber pressure outside [0, p_s], where the model's
    orifices have no real root and the signed root was taken.
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


def drive_of(signals: Signals) -> DrivingInput:
    """Return the drive of a record: its measured spool, supply, and locked joints' motion."""
    return DrivingInput(
        signals.rate, signals.u, signals.p_s, signals.temperature, ~signals.excited,
        signals.q, signals.qd, signals.qdd,
    )  # fmt: skip


@dataclass(frozen=True)
class Compiled:
    """A model in the integrator's arrays."""

    addresses: NDArray[np.int64]
    ends: NDArray[np.int64]
    hidden_ends: NDArray[np.int64]
    prepares: NDArray[np.bool_]
    par: Array
    geometry: Array
    rate_tolerance: float


def compiled(model: Model) -> Compiled:
    """Lay a model out for the integrator; raises InputError where a parameter is not identified."""
    missing = [name for name, p in model.parameters.items() if not p.identified]
    if missing:
        raise InputError(
            f"the model cannot be simulated: {' '.join(missing)} not identified; identify again "
            "with records that excite them"
        )
    values = model.values
    packed = [u.term.pack(model.rig, values, u.shape) for u in model.terms]
    return Compiled(
        np.array([u.term.kernel.address for u in model.terms], dtype=np.int64),
        np.cumsum([0, *(len(p) for p in packed)]),
        np.cumsum([0, *(u.term.hidden(model.rig) for u in model.terms)]),
        np.array([u.term.prepares for u in model.terms]),
        np.concatenate(packed),
        _geometry(model.rig),
        min(u.term.tolerance(u.shape) for u in model.terms),
    )


@functools.lru_cache(maxsize=16)
def _geometry_cached(rows: tuple[tuple[float, ...], ...]) -> Array:
    return np.array(rows)


def _geometry(rig: Rig) -> Array:
    if rig.electric:
        rows = [[0.0] * 10 for _ in rig.joints]
        for row, gain in zip(rows, rig.drive_gains, strict=True):
            row[integrator.GAIN] = gain
        rows[0][integrator.OFFSET] = rig.base_angle
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
    """Simulate `samples` samples of the drive from sample `first` on, beginning in `start`.

    Pass the result of `compiled` instead of a model to simulate many stretches. A state that
    ceases to exist ends the run and is reported in `failure`, with the last state held.
    """
    ready = compiled(model) if isinstance(model, Model) else model
    total = len(drive.u)
    samples = total - first if samples is None else samples
    N = drive.u.shape[1]
    hidden = int(ready.hidden_ends[-1])
    ys = np.zeros((samples, 4 * N + hidden))
    ys[0, : 4 * N] = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    if start.hidden is not None:
        ys[0, 4 * N :] = start.hidden
    inputs = _inputs(drive)[first : first + samples]
    atol = np.repeat(
        [ATOL_ANGLE, ready.rate_tolerance, ATOL_PRESSURE, ATOL_PRESSURE, ATOL_HIDDEN],
        [N, N, N, N, hidden],
    )
    status, filled, evaluations = integrator.integrate(
        (ready.addresses, ready.ends, ready.hidden_ends, ready.prepares, ready.par),
        np.ascontiguousarray(inputs), drive.rate, drive.locked, ready.geometry, RTOL, atol, ys,
        _workspace(N),
    )  # fmt: skip
    ys[filled:] = ys[filled - 1]
    failure = ""
    if status != integrator.OK:
        failure = f"{_REASONS[status]} {filled / drive.rate:.3f} s after the start"
    return _result(ready.geometry, drive, inputs, ys, failure, filled, evaluations)


def _result(
    geometry: Array, drive: DrivingInput, inputs: Array, ys: Array, failure: str, filled: int,
    evaluations: int,
) -> Simulation:  # fmt: skip
    N = drive.u.shape[1]
    q, qd, cap, rod = (ys[:, k * N : (k + 1) * N].copy() for k in range(4))
    q[:, drive.locked] = inputs[:, 2 + N : 2 + 2 * N][:, drive.locked]
    qd[:, drive.locked] = inputs[:, 2 + 2 * N : 2 + 3 * N][:, drive.locked]
    evaluated = int(evaluations)
    if (geometry[:, integrator.GAIN] != 0.0).all():
        return Simulation(
            drive.rate, q, qd, cap, rod, q, qd, failure, int(filled), 0, evaluated, electric=True
        )
    a, c, mid, offset = geometry[:, :4].T
    length = np.sqrt(a**2 + c**2 - 2 * a * c * np.cos(q + offset))
    slope = a * c * np.sin(q + offset) / length
    free = ~drive.locked
    p_s = inputs[:filled, :1]
    beyond = np.zeros(filled, dtype=bool)
    for p in (cap, rod):
        beyond |= ((p[:filled, free] < 0) | (p[:filled, free] > p_s)).any(axis=1)
    return Simulation(
        drive.rate, q, qd, cap, rod, length - mid, slope * qd, failure, int(filled),
        int(beyond.sum()), evaluated,
    )  # fmt: skip


def rates_of(ready: Compiled, drive: DrivingInput) -> Callable[[float, Array], Array]:
    """Return dy/dt(t, y) of a compiled model under a drive, for other integrators to use."""
    N = drive.u.shape[1]
    inputs = np.ascontiguousarray(_inputs(drive))
    work = _workspace(N)
    parts = (ready.addresses, ready.ends, ready.hidden_ends, ready.prepares, ready.par)

    def rates(t: float, y: Array) -> Array:
        dy = np.zeros_like(y)
        integrator.rates(t, y, dy, inputs, drive.rate, drive.locked, ready.geometry, parts, work)
        return dy

    return rates


def _inputs(drive: DrivingInput) -> Array:
    return np.column_stack((drive.p_s, drive.temperature, drive.u, drive.q, drive.qd, drive.qdd))


def _workspace(joints: int) -> tuple[Array, Array, Array, Array, Array]:
    N = joints
    return (
        np.zeros(4), np.zeros((X_ROWS, N)), np.zeros((OUT_ROWS, N)), np.zeros((N, N)), np.zeros(N),
    )  # fmt: skip


def state_at(signals: Signals, sample: int) -> State:
    """Return the measured state at one sample of the filtered signals."""
    return State(
        signals.q[sample], signals.qd[sample], signals.p_cap[sample], signals.p_rod[sample]
    )


def put_right(rig: Rig, terms: Sequence[Used], signals: Signals) -> Signals:
    """Return signals free of what terms say of sensors; other terms prepare in simulation."""
    for used in terms:
        if not used.term.prepares:
            signals = used.term.prepare(rig, signals, used.shape)
    return signals


def hidden_paths(model: Model, signals: Signals) -> Array:
    """Return the terms' own states (n, h) along measured signals, in the model's order.

    Every term sees the signals as those before it prepared them, as in simulation. `signals` are
    free of what sensors distort.
    """
    values, out = model.values, [np.zeros((len(signals.t), 0))]
    last = max((k for k, u in enumerate(model.terms) if u.term.hidden(model.rig)), default=-1)
    for used in model.terms[: last + 1]:
        out.append(used.term.hidden_path(model.rig, signals, values, used.shape))
        if used.term.prepares:
            signals = used.term.prepare(model.rig, signals, used.shape)
    return np.concatenate(out, axis=1)
