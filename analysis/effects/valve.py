"""Effects between the spool's LVDT and the metering edges: dead band, null, lag.

They change the opening u in the orifices' equations, so that all of them are shapes: dq =
C(u_effective) sqrt(dp). (Underlap: `underlap.py`; hysteresis: `hysteresis.py`.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numba import njit
from scipy.linalg import expm

from analysis.effects.base import (
    EDGES,
    LAG,
    NULL,
    Array,
    Shape,
    SignalEffect,
    between_samples,
    longest_lag,
)
from analysis.effects.edges import CORNER, corner, edge, opened, rounding
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    PREPARE,
    Columns,
    U,
    equation,
    kernel,
)
from analysis.terms.hydraulics import joint_edge_columns, signed_root
from rig.model.parameters import gain_names
from rig.model.rig import Rig


@dataclass(frozen=True)
class ValveEffect(SignalEffect):
    """Common parts of valve effects: a hydraulic joint, no linear unknown, spool as abscissa."""

    mechanism = "metering_curve"
    element = "valve"
    hydraulic = True
    family = "valve"
    quantity = "spool"
    alters = ("fluid",)
    prepares = True
    where: str = "joint 1"

    def with_opening(self, signals: Signals, opening: Array) -> Signals:
        """Return the signals with the joint's opening (n,) [V] in the place of its spool."""
        u = signals.u.copy()
        u[:, self.joint] = opening
        return replace(signals, u=u)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, shape."""
        return np.array([self.joint, *self.full_shape(rig, shape)], dtype=np.float64)


# Rounding r over overlap w at which a round edge's gain at the null, 1 - w / sqrt(w^2 + r^2), is
# half of that far from it.
MOST_ROUND: Final = 1.7
# Gain at the null over that far from it, above which edges with a corner do not close there; the
# most rounded dead bands of the odd seeds have 0.02.
OPEN_AT_NULL: Final = 0.1
MOST_LATER: Final = 0.2  # largest further overlap of one pair of edges, over the spool's stroke
LATER: Final = 0.5  # start of its search, over the smaller overlap


@kernel
def _deadband(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    i = int(par[0])
    later = par[5]
    if phase == PREPARE:
        positive = edge(x[U, i] - par[1], par[3], par[4])
        x[U, i] = positive - edge(-x[U, i] - par[2], par[3], par[4])
    elif phase == CONTRIBUTE and later != 0.0:
        u = x[U, i]
        size = abs(u)
        less = size - min(size, edge(size - abs(later), par[3], par[4]))
        cap, rod, p_s, p_t = x[P_CAP, i], x[P_ROD, i], bench[P_S], bench[P_TANK]
        if later > 0.0 and u > 0.0:
            out[FLOW_ROD, i] += par[8] * less * signed_root(rod - p_t)
        elif later > 0.0:
            out[FLOW_CAP, i] += par[7] * less * signed_root(cap - p_t)
        elif u > 0.0:
            out[FLOW_CAP, i] -= par[6] * less * signed_root(p_s - cap)
        else:
            out[FLOW_ROD, i] -= par[9] * less * signed_root(p_s - rod)


@dataclass(frozen=True)
class ValveDeadband(ValveEffect):
    """Overlapped edges: no opening for -w_astern < u < w_ahead, u less the overlap outside.

    An edge at x is open by (x + (|x|^n + r^n)^(1/n)) / 2, n = 2 + c: r the rounding, 0 for a sharp
    edge, c its corner, 0 where only clearance rounds it (see `edges`). With a further overlap d, a
    detail of the form, the edges to the tank open by d later than those from the supply: where
    these are open by x, those are open by x - d. A negative d is that of the edges from the supply.
    Source: Merritt 1967, chapter 5 (overlap, "dead band"); Jelali and Kroll 2003.
    Without it the flow gains are biased: 10 mV make those of the seed bench 12 to 17 % too small.
    """

    name = "valve_deadband"
    smallest_shape = (2e-3, 2e-3)  # [V]
    stage = EDGES
    variable = "the spool near its null"
    confounders = ("spool_offset", "underlap_leakage", "spool_lag")
    excludes = ("underlap_leakage",)
    separated_by = "small spool amplitudes about the null beside large ones, both edges reached"
    shape_stems = ("w_ahead", "w_astern", "rounding", "corner", "w_tank")
    kernel = _deadband

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the overlaps [V], up to four tenths of the spool's stroke, and the edges' form."""
        stroke = rig.joints[self.joint].valve.spool_stroke
        grid = (0.003 * stroke, 0.01 * stroke, 0.05 * stroke, 0.2 * stroke)
        *edges, r, c, tank = self.shape_names()
        laps = [Shape(name, "V", 0.0, 0.4 * stroke, grid, 0.0) for name in edges]
        most = MOST_LATER * stroke
        later = Shape(tank, "V", -most, most, (0.1 * most,), detail=True)
        return (*laps, rounding(r, stroke), corner(c), later)

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape with a corner, and with either pair of edges opening later.

        The overlaps of a shape without that are the mean of those of both pairs.
        """
        w_ahead, w_astern, r, c, further = self.full_shape(rig, shape)
        cornered = (w_ahead, w_astern, r, c or CORNER, *((further,) if further else ()))
        if further:
            return (cornered,)
        later = LATER * min(w_ahead, w_astern)
        laps = w_ahead - 0.5 * later, w_astern - 0.5 * later
        return (cornered, (*laps, r, c, later), (*laps, r, c, -later))

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Remove the dead band from the spool's signal."""
        u = signals.u[:, self.joint]
        return self.with_opening(signals, self.opening(u, *self.full_shape(rig, shape)[:4]))

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return what edges that open later lack, times the roots, under the orifices' gains."""
        *_, r, c, later = self.full_shape(rig, shape)
        if not later:
            return {}
        u = signals.u[:, self.joint]
        size = np.abs(u)
        less = size - np.minimum(size, opened(size - abs(later), r, c))
        positive, negative = np.where(u > 0.0, less, 0.0), np.where(u > 0.0, 0.0, less)
        columns = joint_edge_columns(signals, self.joint, -positive, -negative)
        pp, pm, mp, mm = gain_names(self.joint + 1)
        of_pair = (pm, mp) if later > 0.0 else (pp, mm)
        return {e: {n: row[n] for n in of_pair if n in row} for e, row in columns.items()}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, shape, the joint's gains."""
        gains = [values[name] for name in gain_names(self.joint + 1)]
        return np.array([self.joint, *self.full_shape(rig, shape), *gains])

    def opening(self, u: Array, w_ahead: float, w_astern: float, r: float, c: float) -> Array:
        """Return the opening (n,) [V] at the spool u (n,) [V], of overlaps and edge form."""
        return opened(u - w_ahead, r, c) - opened(-u - w_astern, r, c)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a shape at its bounds, and edges with a corner that are open at the null."""
        form = self.full_shape(rig, shape)[:4]
        near = 1e-3 * max(form[:2])
        low, high = self.opening(np.array([-near, near]), *form)
        if form[3] > 0.0 and high - low > OPEN_AT_NULL * 2.0 * near:
            share = (high - low) / (2.0 * near)
            return (
                f"the edges do not close: the gain at the null is {share:.0%} of that far from it"
            )
        return super().problem(rig, values, shape)

    def limited_shape(self, shape: Sequence[float]) -> tuple[float, ...]:
        """Limit the rounding: a valve with a larger one is open at its null."""
        most = MOST_ROUND * max(shape[:2])
        return (*shape[:2], *(min(r, most) for r in shape[2:3]), *shape[3:])


@kernel
def _offset(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        x[U, int(par[0])] -= par[1]


@dataclass(frozen=True)
class SpoolOffset(ValveEffect):
    """The edges' null is at u0 of the LVDT: opening u - u0 (Merritt 1967, chapter 5, "null").

    Without it the gains of the two directions are biased with opposite signs (5 mV: 7 to 9 % on the
    seed bench).
    """

    name = "spool_offset"
    exact = True
    smallest_shape = (1e-3,)  # [V]
    stage = NULL
    variable = "the spool's sign"
    confounders = ("valve_deadband", "internal_leakage")
    separated_by = (
        "two spool amplitudes: the flow error stays the same, that of a gain grows with them"
    )
    shape_stems = ("u_null",)
    kernel = _offset

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the null [V], within a tenth of the spool's stroke."""
        stroke = rig.joints[self.joint].valve.spool_stroke
        near, far = 0.003 * stroke, 0.02 * stroke
        grid = (-far, -near, near, far)
        return (Shape(self.shape_names()[0], "V", -0.1 * stroke, 0.1 * stroke, grid, 0.0),)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Subtract the null from the spool's signal."""
        return self.with_opening(signals, signals.u[:, self.joint] - self.shape_of(rig, shape)[0])

    def inseparable(self, shape: Sequence[float] = ()) -> tuple[tuple[str, str], ...]:
        """Return the LVDT's own offset: data cannot separate valve and sensor."""
        return (("sensor_offset", f"joint {self.joint + 1} spool"),)


QUICKEST: Final = 1e-4  # [s] smallest time constant that the integrator can follow
# Damping ratios [-] of spools: with a larger one the faster of the two poles hardly shows.
DAMPING_BOUNDS: Final = (0.3, 1.5)
DAMPING_START: Final = 0.8


@kernel
def _lag(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        i = int(par[0])
        if par[2] > 0.0:
            frequency = 2.0 * par[2] / par[1]
            dz[0] = z[1]
            dz[1] = frequency * (frequency * (x[U, i] - z[0]) - 2.0 * par[2] * z[1])
        else:
            dz[0] = (x[U, i] - z[0]) / par[1]
            dz[1] = -z[1] / par[1]
        x[U, i] = z[0] - par[3] / 2.0 * dz[0] + par[3] ** 2 / 6.0 * dz[1]


@dataclass(frozen=True)
class SpoolLag(ValveEffect):
    """The opening follows the LVDT: tau dx/dt = u - x (Jelali and Kroll 2003).

    With a damping ratio zeta, a detail of the form, the lag is of second order: with the natural
    frequency w = 2 zeta / tau, so that tau remains the delay of slow motion, d2x/dt2 + 2 zeta w
    dx/dt + w^2 x = w^2 u (Merritt 1967, as data sheets of valves state it). x and dx/dt are hidden
    states; the rows use the exact response to the sampled spool, linear between samples. With
    `held` the input has a zero-order hold, as a command recorded in place of the spool has. A hold
    of T is (1 - exp(-s T)) / (s T) = 1 - s T / 2 + (s T)^2 / 6 - ...: it is applied to x, for a
    first-order lag up to s T / 2.
    """

    mechanism = "spool_dynamics"
    element = "valve"
    name = "spool_lag"
    smallest_shape = (1e-3,)  # [s]
    stage = LAG
    variable = "the spool's velocity"
    quantity = "spool rate"
    confounders = ("channel_delay", "valve_deadband", "entrained_air")
    separated_by = "high frequencies: a lag loses amplitude there, a delay only phase"
    shape_stems = ("tau_spool", "zeta_spool", "held_spool")
    kernel = _lag

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the time constant [s], the damping ratio [-] and whether the input is held (1)."""
        tau, zeta, held = self.shape_names()
        grid = (5e-4, 2e-3, 1e-2, 4e-2)
        return (
            Shape(tau, "s", 0.0, longest_lag(rig), grid, 0.0),
            Shape(zeta, "", *DAMPING_BOUNDS, (DAMPING_START,), saturates=True, detail=True),
            Shape(held, "", 1.0, 1.0, (1.0,), detail=True, fixed=True),
        )

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape with a damping ratio."""
        tau, zeta, _ = self.full_shape(rig, shape)
        return ((tau, zeta or DAMPING_START, *shape[2:]),)

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the lag with the other kind of input: held or linear between samples.

        A hold, half a sample of delay, is tried only on lags of at least a sample.
        """
        tau, zeta, held = self.full_shape(rig, shape)
        if held:
            return ((tau, zeta) if zeta else (tau,),)
        return ((tau, zeta, 1.0),) if tau * rig.sample_rate >= 1.0 else ()

    def hidden(self, rig: Rig) -> int:
        """Return 2: the opening and its rate."""
        return 2

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Delay the spool's signal by the lag, and by half a sample where the input is held."""
        tau, zeta, held = self.full_shape(rig, shape)
        x, rate = self.hidden_path(rig, signals, {}, shape).T
        if held:
            tau = max(tau, QUICKEST)
            error, acceleration = signals.u[:, self.joint] - x, 0.0
            if zeta:
                frequency = 2.0 * zeta / tau
                acceleration = frequency * (frequency * error - 2.0 * zeta * rate)
            else:
                rate = error / tau
            T = 1.0 / rig.sample_rate
            x = x - T / 2.0 * rate + T**2 / 6.0 * acceleration
        return self.with_opening(signals, x)

    def hidden_path(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the opening [V] and its rate [V/s], (n, 2); the rate of a first order as 0."""
        u = np.ascontiguousarray(signals.u[:, self.joint])
        tau, zeta, _ = self.full_shape(rig, shape)
        samples = tau * signals.rate
        if zeta:
            path: Array = second_order(u, samples, zeta) * (1.0, signals.rate)
            return path
        return np.column_stack((lagged(u, samples), np.zeros(len(u))))

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a shape at its bounds, and a lag that sampling may cause (`between_samples`)."""
        return super().problem(rig, values, shape) or between_samples(
            rig, self.shape_of(rig, shape)[0]
        )

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State natural frequency and damping ratio of a second order, and a held input."""
        tau, zeta, held = self.full_shape(rig, shape)
        remarks = []
        if zeta:
            remarks.append(
                f"the spool's lag is of second order, with a natural frequency of "
                f"{zeta / (math.pi * tau):.3g} Hz and a damping ratio of {zeta:.2g}; "
                f"tau_spool_{self.joint + 1} is its delay in slow motion"
            )
        if held:
            remarks.append(
                f"the lag fits better with spool_{self.joint + 1} constant between samples, as a "
                "recorded command is, than linear"
            )
        return "; ".join(remarks)

    def fastest(self, shape: Sequence[float]) -> float:
        """Return the rate [1/s] of the fastest pole, as simulated."""
        if not len(shape):
            return 0.0
        zeta = shape[1] if len(shape) > 1 else 0.0
        quicker = 2.0 * zeta * (zeta + math.sqrt(max(zeta * zeta - 1.0, 0.0)))
        return max(1.0, 2.0 * zeta, quicker) / max(shape[0], QUICKEST)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, time constant [s] of at least `QUICKEST`, damping ratio, hold [s]."""
        tau, zeta, held = self.full_shape(rig, shape)
        return np.array([self.joint, max(tau, QUICKEST), zeta, held / rig.sample_rate])

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the spool's velocity [V/s]."""
        rate = np.gradient(signals.u[:, self.joint]) * signals.rate
        return {equation(kind, self.joint): rate for kind in ("flow_cap", "flow_rod")}


def lagged(u: Array, tau: float) -> Array:
    """Return the response (n,) of a first-order lag of `tau` samples, at rest before the first."""
    return u if tau < 1e-3 else np.asarray(_lagged(u, tau))


def second_order(u: Array, tau: float, zeta: float) -> Array:
    """Return the response and its rate per sample (n, 2) of a lag of second order.

    Its delay in slow motion is `tau` samples and its damping ratio `zeta`; it is at rest before the
    first sample. Exact for u linear between samples (Van Loan 1978: the matrix exponential of the
    states with the input and its slope).
    """
    frequency = 2.0 * zeta / max(tau, 1e-3)
    rates = np.zeros((4, 4))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = -(frequency**2), -2.0 * zeta * frequency, frequency**2, 0.0
    return np.asarray(_second_order(u, np.ascontiguousarray(expm(rates)[:2])))


@njit(cache=True)
def _lagged(u, tau):  # type: ignore[no-untyped-def]
    # Exact for u linear between samples: x lags a ramp by tau times its slope.
    decay = math.exp(-1.0 / tau)
    x = np.empty_like(u)
    x[0] = u[0]
    for k in range(1, len(u)):
        slope = u[k] - u[k - 1]
        behind = x[k - 1] - (u[k - 1] - tau * slope)
        x[k] = u[k] - tau * slope + behind * decay
    return x


@njit(cache=True)
def _second_order(u, step):  # type: ignore[no-untyped-def]
    # A row of `step`: weights of the two states, of the input and of its slope.
    x = np.zeros((len(u), 2))
    x[0, 0] = u[0]
    for k in range(1, len(u)):
        slope = u[k] - u[k - 1]
        for i in range(2):
            x[k, i] = (
                step[i, 0] * x[k - 1, 0] + step[i, 1] * x[k - 1, 1]
                + step[i, 2] * u[k - 1] + step[i, 3] * slope
            )  # fmt: skip
    return x


TERMS = (ValveDeadband, SpoolOffset, SpoolLag)
