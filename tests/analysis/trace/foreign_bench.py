"""Joint 2 of the seed bench in forms that share no formula with `analysis.effects`.

Dry friction is a function of the velocity at the same instant (a hyperbolic tangent, an algebraic
sigmoid, or Karnopp's band of standstill), never of the path; the supply sags in proportion to the
flow drawn; a leak is laminar. The equations of motion are those of `docs`' NOTES with joint 1
standing at mid-stroke, typed in again, integrated by a Runge-Kutta of fixed step. Sensors are
sampled at their own instants and get white noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.effects.one_joint import CHANNELS, NAMES_1, excitation, record
from tests.analysis.small_bench import TRUTH, angle

Array = NDArray[np.float64]

STEP = 4e-5  # [s] of the integrator: a tenth of the time in which the sharpest friction settles
SETTLE = 4.0  # [s] before the record begins
CENTRING = 0.3  # [V/m] that keep the piston about mid-stroke
PUMP = 11.7e-3 / 60  # [m^3/s]
RMS = 0.03  # [V] of the spool in training records; held-out ones have seven tenths
TANH, SIGMOID, KARNOPP = range(3)


@dataclass(frozen=True)
class Hidden:
    """What is wrong with the bench; nothing by default.

    `ahead`, `astern` [N] are the levels of dry friction extending and retracting, `width` [m/s]
    the speed of its transition in the given `form`, `breakaway` [N] what it holds more near
    standstill, gone above `stribeck` [m/s]; `leak` [m^3/(s Pa)] is past the piston; `sag` [Pa] is
    the drop of the supply at the pump's whole flow.
    """

    ahead: float = 0.0
    astern: float = 0.0
    width: float = 1e-3
    form: int = TANH
    breakaway: float = 0.0
    stribeck: float = 0.02
    leak: float = 0.0
    sag: float = 0.0

    @property
    def array(self) -> Array:
        """Its numbers, in the order of the fields."""
        return np.array([
            self.ahead, self.astern, self.width, self.form, self.breakaway, self.stribeck,
            self.leak, self.sag,
        ])  # fmt: skip


@njit(cache=True)
def _dry(v, force, hidden):
    """Friction [N] at the speed v under the other forces' sum; Karnopp's holds within its band."""
    level = hidden[0] if v > 0.0 else hidden[1]
    level += hidden[4] / (1.0 + (v / hidden[5]) ** 2)
    if hidden[3] == KARNOPP:
        if abs(v) < hidden[2]:
            return min(max(force, -hidden[1]), hidden[0])
        return level if v > 0.0 else -level
    x = v / hidden[2]
    return level * (x / math.sqrt(1.0 + x * x) if hidden[3] == SIGMOID else math.tanh(x))


@njit(cache=True)
def _supply(cap, rod, u, par, sag):
    """Supply pressure at the valve [Pa]: Q^2 = g^2 (7e6 - k Q - p) for the flow Q drawn."""
    gain, held = (par[4], cap) if u > 0.0 else (par[7], rod)
    square, slope = (gain * u) ** 2, sag / PUMP
    head = max(7e6 - held, 0.0)
    flow = 0.5 * (math.sqrt((square * slope) ** 2 + 4.0 * square * head) - square * slope)
    return 7e6 - slope * flow


@njit(cache=True)
def _linkage(q):
    length = math.sqrt(0.27**2 + 0.10**2 + 2 * 0.27 * 0.10 * math.cos(q))
    return length - 0.30, -0.27 * 0.10 * math.sin(q) / length


@njit(cache=True)
def _command(t, s, wave, bias):
    u = bias - CENTRING * s
    for row in wave:
        u += row[0] * math.cos(row[1] * t + row[2])
    return u


@njit(cache=True)
def _rates(y, t, q1, par, hidden, wave, bias, out):
    q, w, cap, rod = y
    s, G = _linkage(q)
    v = G * w
    u = _command(t, s, wave, bias)
    p_s = _supply(cap, rod, u, par, hidden[7])
    leak = hidden[6] * (cap - rod)
    if u > 0.0:
        into_cap = par[4] * u * math.sqrt(max(p_s - cap, 0.0)) - leak
        into_rod = leak - par[6] * u * math.sqrt(max(rod, 0.0))
    else:
        into_cap = par[5] * u * math.sqrt(max(cap, 0.0)) - leak
        into_rod = leak - par[7] * u * math.sqrt(max(p_s - rod, 0.0))
    torque = G * (7.0e-4 * cap - 5.4e-4 * rod) - par[1] * w - par[2] * 9.8 * math.sin(q1 + q)
    friction = _dry(v, torque / G, hidden)
    out[0], out[1] = w, (torque - G * friction) / par[0]
    out[2] = par[3] * (into_cap - 7.0e-4 * v) / (6.3e-5 + (0.0375 + s) * 7.0e-4)
    out[3] = par[3] * (into_rod + 5.4e-4 * v) / (6.3e-5 + (0.0375 - s) * 5.4e-4)


@njit(cache=True)
def _integrated(start, steps, q1, par, hidden, wave, bias):
    """States (steps + 1, 4): angle [rad], speed [rad/s], cap and rod pressure [Pa]."""
    y, out = start.copy(), np.zeros((steps + 1, 4))
    out[0] = y
    a, b, c, d = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    for k in range(steps):
        t = k * STEP
        _rates(y, t, q1, par, hidden, wave, bias, a)
        _rates(y + 0.5 * STEP * a, t + 0.5 * STEP, q1, par, hidden, wave, bias, b)
        _rates(y + 0.5 * STEP * b, t + 0.5 * STEP, q1, par, hidden, wave, bias, c)
        _rates(y + STEP * c, t + STEP, q1, par, hidden, wave, bias, d)
        y += STEP / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        out[k + 1] = y
    return out


def _states(hidden: Hidden, wave: Array, bias: float, seconds: float) -> Array:
    q1, q2 = angle(0.0, 0), angle(0.0, 1)
    par = np.array([TRUTH[name] for name in NAMES_1])
    hold = TRUTH["W2"] * 9.8 * math.sin(q1 + q2) / _linkage(q2)[1]
    start = np.array([q2, 0.0, (hold + 5.4e-4 * 3.5e6) / 7.0e-4, 3.5e6])
    steps = round((SETTLE + seconds) / STEP)
    return np.asarray(_integrated(start, steps, q1, par, hidden.array, wave, bias))


def _pistons(q: Array) -> Array:
    length = np.sqrt(0.27**2 + 0.10**2 + 2 * 0.27 * 0.10 * np.cos(q))
    return np.asarray(length - 0.30)


def channels(rig: Rig, hidden: Hidden, wave: Array, seconds: float) -> dict[str, Array]:
    """Return noise-free channels, each at its own instants; the mean stroke is at the middle."""
    bias = 0.0
    for _ in range(2):
        bias -= CENTRING * float(_pistons(_states(hidden, wave, bias, 4.0)[100_000:, 0]).mean())
    y = _states(hidden, wave, bias, seconds)
    time = STEP * np.arange(len(y))
    n = round(seconds * rig.sample_rate)
    tick = SETTLE + np.arange(n) / rig.sample_rate
    out = {
        "spool_1": np.zeros(n), "piston_1": np.zeros(n),
        "cap_pressure_1": np.full(n, 3.5e6), "rod_pressure_1": np.full(n, 3.5e6),
        "supply_pressure": np.full(n, 7e6), "oil_temperature": np.full(n, 40.0),
    }  # fmt: skip
    for kind in CHANNELS:
        at = tick + rig.sensors.skew * rig.channels.index(f"{kind}_2")
        at = np.minimum(at, time[-1])
        q, _, cap, rod = (np.interp(at, time, y[:, k]) for k in range(4))
        spool = [_command(t, s, wave, bias) for t, s in zip(at, _pistons(q), strict=True)]
        out[f"{kind}_2"] = {
            "spool": np.array(spool), "piston": _pistons(q),
            "cap_pressure": cap, "rod_pressure": rod,
        }[kind]  # fmt: skip
    return out


def experiment(
    rig: Rig, hidden: Hidden, *, repeats: int, seed: int, rms: float = RMS, noise: float = 1.0,
    seconds: float = 8.0,
) -> Run:  # fmt: skip
    """Return a run of `repeats` repeats with `noise` times the rig's stated sensor noise."""
    clean = channels(rig, hidden, excitation(rms, seed), seconds)
    records = tuple(
        replace(
            record(rig, clean, f"step1_r{k}", 1000 * seed + k, noise),
            repeat=k,
            period=4000 if seconds >= 8.0 else None,
        )
        for k in range(1, repeats + 1)
    )
    return Run(rig, records, f"foreign bench, seed {seed}")


def pair_of_runs(
    rig: Rig, hidden: Hidden, *, repeats: int = 4, noise: float = 1.0, seconds: float = 8.0,
    seed: int = 1,
) -> tuple[Run, Run]:  # fmt: skip
    """Return training run and held-out run (another excitation at seven tenths) of one bench."""
    return (
        experiment(rig, hidden, repeats=repeats, seed=seed, noise=noise, seconds=seconds),
        experiment(rig, hidden, repeats=min(repeats, 2), seed=seed + 1, rms=0.7 * RMS, noise=noise,
                   seconds=seconds),
    )  # fmt: skip
