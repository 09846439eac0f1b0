"""Joint 2 of the seed bench in forms that share no formula with `analysis.effects`.

Dry friction is a function of the velocity at the same instant (a hyperbolic tangent, two algebraic
sigmoids, or Karnopp's band of standstill), never of the path; the supply sags in proportion to the
flow drawn, at once or behind a lag; a leak is laminar or goes by the root of the pressure, edges
may be laminar at small drops. Viscous friction may have slopes by direction or a cube; a spring may
harden; a spool may have play and its edges a taper; the return may stand under the pressure of a
laminar line; oil may stiffen with pressure. The equations of motion are those of `docs`' NOTES with
joint 1 standing at mid-stroke, typed in again, integrated by a Runge-Kutta of fixed step. Sensors
are sampled at their own instants, may lag, be late or see each other, and get white noise.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.effects.one_joint import CHANNELS, NAMES_1, excitation, record
from tests.analysis.small_bench import TRUTH, angle

Array = NDArray[np.float64]

STEP = 4e-5  # [s] of the integrator: a tenth of the time in which the sharpest friction settles
PERIOD = 4.0  # [s] of the excitation
SETTLE = 4.0  # [s] before the record begins
CENTRING = 0.3  # [V/m] that keep the piston about mid-stroke
PUMP = 11.7e-3 / 60  # [m^3/s]
RMS = 0.03  # [V] of the spool in training records; held-out ones have seven tenths
TANH, SIGMOID, KARNOPP, SLOW = range(4)
(
    AHEAD, ASTERN, WIDTH, FORM, BREAKAWAY, STRIBECK, LEAK, SAG, DRAG_AHEAD, DRAG_ASTERN, DRAG_CUBED,
    SPRING, HARDENING, HUM, HUM_FREQUENCY, HUM_POWER, LEAK_ROOT, TAPER, PLAY, BACK, SAG_LAG,
    STIFFER, BACK_POWER, SPRING_REST, KNEE, TIGHTER, WORN, SPOOL, SPOOL_DAMPING,
    LAMINAR, REYNOLDS, HOSES, HOSE_PRESSURE,
) = range(33)  # fmt: skip
MIDDLE = -1.44  # [rad] where springs are at rest


@dataclass(frozen=True)
class Hidden:
    """What is wrong with the bench; nothing by default.

    `ahead`, `astern` [N] are the levels of dry friction extending and retracting, `width` [m/s]
    the speed of its transition in the given `form`, `breakaway` [N] what it holds more near
    standstill, gone above `stribeck` [m/s]; `leak` [m^3/(s Pa)] is past the piston; `sag` [Pa] is
    the drop of the supply at the pump's whole flow, behind a lag of `sag_lag` [s].

    `drag_ahead`, `drag_astern` [N s/m] are slopes of viscous friction by direction, `drag_cubed`
    [N s^3/m^3] goes with the cube of the speed; `spring` [N m/rad] and `hardening` [N m/rad^3] pull
    at the joint about `spring_rest` [rad]; `hum` [N m] is a torque of `hum_frequency` [Hz] that
    begins with the record, its sine raised to `hum_power`; `leak_root` [m^3/(s Pa^0.5)]; `taper`
    [1/V]: an opening of x + taper x |x|; `play` [V] of the spool behind its sensor, half of it
    either way; `back` [Pa] is the return's pressure at the pump's flow, which rises with the flow
    to the `back_power`; `stiffer` [1/Pa] is the relative growth of the bulk modulus with pressure;
    within `knee` [V] of the null the edges have half their gain; the levels of dry friction grow by
    e with every 1 / `tighter` [m] of the stroke; at mid-stroke, about 1 cm wide, the leak is 1 +
    `worn` times as large; the opening follows the spool's signal by a lag of second order
    of natural frequency `spool_frequency` [Hz] and damping ratio `spool_damping`; of a drop dp
    across an edge its root passes times x / (x + 1), x = 2 (dp / `laminar`)^(1/2), or, where
    `reynolds` is 1, times tanh(x). `hoses` [m^3] are further volumes at both chambers that stiffen
    under pressure, to half of it at `hose_pressure` [Pa].
    """

    ahead: float = 0.0
    astern: float = 0.0
    width: float = 1e-3
    form: int = TANH
    breakaway: float = 0.0
    stribeck: float = 0.02
    leak: float = 0.0
    sag: float = 0.0
    drag_ahead: float = 0.0
    drag_astern: float = 0.0
    drag_cubed: float = 0.0
    spring: float = 0.0
    hardening: float = 0.0
    hum: float = 0.0
    hum_frequency: float = 7.0
    hum_power: float = 1.0
    leak_root: float = 0.0
    taper: float = 0.0
    play: float = 0.0
    back: float = 0.0
    sag_lag: float = 0.0
    stiffer: float = 0.0
    back_power: float = 1.0
    spring_rest: float = MIDDLE
    knee: float = 0.0
    tighter: float = 0.0
    worn: float = 0.0
    spool_frequency: float = 0.0
    spool_damping: float = 0.7
    laminar: float = 0.0
    reynolds: float = 0.0
    hoses: float = 0.0
    hose_pressure: float = 2e6

    @property
    def array(self) -> Array:
        """Its numbers, in the order of the fields."""
        return np.array(astuple(self))


@njit(cache=True)
def _dry(v, s, force, hidden):
    """Friction [N] at speed and place under the other forces' sum; Karnopp's holds in its band."""
    level = hidden[AHEAD] if v > 0.0 else hidden[ASTERN]
    level += hidden[BREAKAWAY] / (1.0 + (v / hidden[STRIBECK]) ** 2)
    if hidden[FORM] == KARNOPP:
        if abs(v) < hidden[WIDTH]:
            return min(max(force, -hidden[ASTERN]), hidden[AHEAD])
        return level if v > 0.0 else -level
    level *= math.exp(hidden[TIGHTER] * s)
    x = v / hidden[WIDTH]
    if hidden[FORM] == SLOW:  # it approaches its level as 1 / x
        return level * x / (1.0 + abs(x))
    return level * (x / math.sqrt(1.0 + x * x) if hidden[FORM] == SIGMOID else math.tanh(x))


@njit(cache=True)
def _drag(v, hidden):
    """Viscous friction [N] by direction and cube, smooth within 0.1 mm/s."""
    much = math.hypot(v, 1e-4)
    ahead, astern = 0.5 * (v + much), 0.5 * (v - much)
    return hidden[DRAG_AHEAD] * ahead + hidden[DRAG_ASTERN] * astern + hidden[DRAG_CUBED] * v**3


@njit(cache=True)
def _supply(cap, rod, u, par, sag):
    """Supply pressure at the valve [Pa]: Q^2 = g^2 (7e6 - k Q - p) for the flow Q drawn."""
    gain, held = (par[4], cap) if u > 0.0 else (par[7], rod)
    square, slope = (gain * u) ** 2, sag / PUMP
    head = max(7e6 - held, 0.0)
    flow = 0.5 * (math.sqrt((square * slope) ** 2 + 4.0 * square * head) - square * slope)
    return 7e6 - slope * flow


@njit(cache=True)
def _return(cap, rod, u, par, hidden):
    """Return pressure at the valve [Pa], by bisection on the flow given back."""
    gain, held = (par[6], rod) if u > 0.0 else (par[5], cap)
    low, high = 0.0, 2e-3
    for _ in range(45):
        flow = 0.5 * (low + high)
        p = hidden[BACK] * (flow / PUMP) ** hidden[BACK_POWER]
        if gain * abs(u) * math.sqrt(max(held - p, 0.0)) > flow:
            low = flow
        else:
            high = flow
    return hidden[BACK] * (low / PUMP) ** hidden[BACK_POWER]


@njit(cache=True)
def _root(x):
    return math.sqrt(x) if x > 0.0 else 0.0


@njit(cache=True)
def _edge(drop, hidden):
    """Root of the drop across an edge [Pa^0.5], less where its flow is laminar."""
    root = _root(drop)
    if hidden[LAMINAR] <= 0.0:
        return root
    x = 2.0 * root / math.sqrt(hidden[LAMINAR])
    return root * (math.tanh(x) if hidden[REYNOLDS] > 0.0 else x / (x + 1.0))


@njit(cache=True)
def _opening(u, held, hidden):
    """Opening behind play (half of it either way), by taper and knee."""
    half = 0.5 * hidden[PLAY]
    x = min(max(held, u - half), u + half) if half > 0.0 else u
    slow = min(max(x, -hidden[KNEE]), hidden[KNEE])
    return x - 0.5 * slow + hidden[TAPER] * x * abs(x), x


@njit(cache=True)
def _linkage(q):
    length = math.sqrt(0.27**2 + 0.10**2 + 2 * 0.27 * 0.10 * math.cos(q))
    return length - 0.30, -0.27 * 0.10 * math.sin(q) / length


@njit(cache=True)
def _excited(t, wave):
    """Sum of the lines of the excitation [V]."""
    u = 0.0
    for row in wave:
        u += row[0] * math.cos(row[1] * t + row[2])
    return u


@njit(cache=True)
def _period(wave):
    """The excitation [V] of a period at every half step of the integrator."""
    out = np.zeros(round(2.0 * PERIOD / STEP))
    for k in range(len(out)):
        out[k] = _excited(0.5 * STEP * k, wave)
    return out


@lru_cache(maxsize=4)
def _drive(wave: bytes) -> Array:
    """The excitation of a period, made once for all plants that it moves."""
    return np.asarray(_period(np.frombuffer(wave).reshape(-1, 3)))


@njit(cache=True)
def _commands(times, pistons, wave, bias):
    out = np.zeros(len(times))
    for k in range(len(times)):
        out[k] = bias - CENTRING * pistons[k] + _excited(times[k], wave)
    return out


@njit(cache=True)
def _rates(y, t, q1, par, hidden, drive, held, out):
    """Write the rates of `y` [1/s] into `out`; `drive` [V] is excitation and bias at `t`."""
    q, w, cap, rod = y[0], y[1], y[2], y[3]
    s, G = _linkage(q)
    v = G * w
    u = drive - CENTRING * s
    out[5] = out[6] = 0.0
    if hidden[SPOOL] > 0.0:
        rate = 2.0 * math.pi * hidden[SPOOL]
        out[5], out[6] = y[6], rate * (rate * (u - y[5]) - 2.0 * hidden[SPOOL_DAMPING] * y[6])
        u = y[5]
    u = _opening(u, held, hidden)[0]
    p_s = _supply(cap, rod, u, par, hidden[SAG])
    out[4] = 0.0
    if hidden[SAG_LAG] > 0.0:
        # The drop follows the flow that is drawn at the pressure of now.
        p_s = 7e6 - y[4]
        gain, side = (par[4], cap) if u > 0.0 else (par[7], rod)
        flow = gain * abs(u) * _root(p_s - side)
        out[4] = (hidden[SAG] * flow / PUMP - y[4]) / hidden[SAG_LAG]
    p_t = _return(cap, rod, u, par, hidden) if hidden[BACK] > 0.0 else 0.0
    across = cap - rod
    leak = hidden[LEAK] * across * (1.0 + hidden[WORN] / (1.0 + (s / 0.01) ** 2))
    if hidden[LEAK_ROOT] > 0.0:
        leak += hidden[LEAK_ROOT] * across / math.sqrt(abs(across) + 1e3)
    if u > 0.0:
        into_cap = par[4] * u * _edge(p_s - cap, hidden) - leak
        into_rod = leak - par[6] * u * _edge(rod - p_t, hidden)
    else:
        into_cap = par[5] * u * _edge(cap - p_t, hidden) - leak
        into_rod = leak - par[7] * u * _edge(p_s - rod, hidden)
    torque = G * (7.0e-4 * cap - 5.4e-4 * rod) - par[1] * w - par[2] * 9.8 * math.sin(q1 + q)
    turn = q - hidden[SPRING_REST]
    torque -= hidden[SPRING] * turn + hidden[HARDENING] * turn**3
    if hidden[HUM] > 0.0:
        wave_now = math.sin(2.0 * math.pi * hidden[HUM_FREQUENCY] * (t - SETTLE))
        sign = 1.0 if wave_now > 0.0 else -1.0
        torque += hidden[HUM] * sign * abs(wave_now) ** hidden[HUM_POWER]
    torque -= G * _drag(v, hidden)
    friction = _dry(v, s, torque / G, hidden)
    out[0], out[1] = w, (torque - G * friction) / par[0]
    stiff_cap = par[3] * (1.0 + hidden[STIFFER] * cap)
    stiff_rod = par[3] * (1.0 + hidden[STIFFER] * rod)
    hose_cap = hidden[HOSES] / (1.0 + cap / hidden[HOSE_PRESSURE])
    hose_rod = hidden[HOSES] / (1.0 + rod / hidden[HOSE_PRESSURE])
    out[2] = stiff_cap * (into_cap - 7.0e-4 * v) / (6.3e-5 + hose_cap + (0.0375 + s) * 7.0e-4)
    out[3] = stiff_rod * (into_rod + 5.4e-4 * v) / (6.3e-5 + hose_rod + (0.0375 - s) * 5.4e-4)


@njit(cache=True)
def _integrated(start, steps, q1, par, hidden, drive, bias, coarse):
    """States (steps + 1, 7): angle [rad], speed [rad/s], cap and rod pressure, sag [Pa].

    The last two are the opening [V] and its rate [V/s] of a spool with a natural frequency.
    `drive` [V] is a period of the excitation at every half of STEP; steps are `coarse` of those.
    """
    dt = coarse * STEP
    y, z, out = start.copy(), start.copy(), np.zeros((steps + 1, 7))
    out[0] = y
    a, b, c, d = np.zeros(7), np.zeros(7), np.zeros(7), np.zeros(7)
    after = bias + drive[0]
    held = after - CENTRING * _linkage(y[0])[0]
    for k in range(steps):
        t = k * dt
        before, middle = after, bias + drive[coarse * (2 * k + 1) % len(drive)]
        after = bias + drive[coarse * (2 * k + 2) % len(drive)]
        _rates(y, t, q1, par, hidden, before, held, a)
        for i in range(7):
            z[i] = y[i] + 0.5 * dt * a[i]
        _rates(z, t + 0.5 * dt, q1, par, hidden, middle, held, b)
        for i in range(7):
            z[i] = y[i] + 0.5 * dt * b[i]
        _rates(z, t + 0.5 * dt, q1, par, hidden, middle, held, c)
        for i in range(7):
            z[i] = y[i] + dt * c[i]
        _rates(z, t + dt, q1, par, hidden, after, held, d)
        for i in range(7):
            y[i] += dt / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i])
        held = _opening(after - CENTRING * _linkage(y[0])[0], held, hidden)[1]
        out[k + 1] = y
    return out


def _states(hidden: Hidden, drive: Array, bias: float, seconds: float, coarse: int = 1) -> Array:
    q1, q2 = angle(0.0, 0), angle(0.0, 1)
    par = np.array([TRUTH[name] for name in NAMES_1])
    hold = TRUTH["W2"] * 9.8 * math.sin(q1 + q2) / _linkage(q2)[1]
    start = np.array([q2, 0.0, (hold + 5.4e-4 * 3.5e6) / 7.0e-4, 3.5e6, 0.0, 0.0, 0.0])
    steps = round((SETTLE + seconds) / (coarse * STEP))
    return np.asarray(_integrated(start, steps, q1, par, hidden.array, drive, bias, coarse))


def _centred(hidden: Hidden, drive: Array) -> float:
    """Return the bias [V] that brings the mean stroke to the middle; for that, coarse steps do."""
    bias = 0.0
    for _ in range(2):
        y = _states(hidden, drive, bias, PERIOD, coarse=2)
        bias -= CENTRING * float(_pistons(y[len(y) // 2 :, 0]).mean())
    return bias


def _pistons(q: Array) -> Array:
    length = np.sqrt(0.27**2 + 0.10**2 + 2 * 0.27 * 0.10 * np.cos(q))
    return np.asarray(length - 0.30)


@dataclass(frozen=True)
class Sensors:
    """What is wrong with the sensors of some `kinds`; nothing by default.

    `late` [s] is a delay, `lag` [s] the time constant of a chain of `stages` equal lags together;
    `seen` is the share of the rod's pressure in the cap's reading.
    """

    kinds: tuple[str, ...] = ()
    late: float = 0.0
    lag: float = 0.0
    stages: int = 1
    seen: float = 0.0

    def behind(self, x: Array) -> Array:
        """Return the fine signal behind its lags."""
        share = STEP * self.stages / self.lag
        for _ in range(self.stages):
            x = lfilter([share], [1.0, share - 1.0], x, zi=[(1.0 - share) * x[0]])[0]
        return x


def channels(
    rig: Rig,
    hidden: Hidden,
    wave: Array,
    seconds: float,
    sensors: Sensors = Sensors(),
) -> dict[str, Array]:
    """Return noise-free channels, each at its own instants; the mean stroke is at the middle."""
    drive = _drive(wave.tobytes())
    bias = _centred(hidden, drive)
    y = _states(hidden, drive, bias, seconds)
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
        at = np.minimum(at, time[-1]) - (sensors.late if kind in sensors.kinds else 0.0)
        q, _, cap, rod = (np.interp(at, time, y[:, k]) for k in range(4))
        if kind == "spool":
            out["spool_2"] = _commands(at, _pistons(q), wave, bias)
            continue
        out[f"{kind}_2"] = {"piston": _pistons(q), "cap_pressure": cap, "rod_pressure": rod}[kind]
        if kind in sensors.kinds and sensors.lag > 0.0:
            fine = {"piston": _pistons(y[:, 0]), "cap_pressure": y[:, 2], "rod_pressure": y[:, 3]}
            out[f"{kind}_2"] = np.interp(at, time, sensors.behind(fine[kind]))
    if sensors.seen:
        out["cap_pressure_2"] = out["cap_pressure_2"] + sensors.seen * out["rod_pressure_2"]
    return out


def experiment(
    rig: Rig, hidden: Hidden, *, repeats: int, seed: int, rms: float = RMS, noise: float = 1.0,
    seconds: float = 8.0, sensors: Sensors = Sensors(),
) -> Run:  # fmt: skip
    """Return a run of `repeats` repeats with `noise` times the rig's stated sensor noise."""
    clean = channels(rig, hidden, excitation(rms, seed), seconds, sensors)
    records = tuple(
        replace(
            record(rig, clean, f"step1_r{k}", 1000 * seed + k, noise),
            repeat=k,
            period=round(4.0 * rig.sample_rate) if seconds >= 8.0 else 0,
        )
        for k in range(1, repeats + 1)
    )
    return Run(rig, records, f"foreign bench, seed {seed}")


def pair_of_runs(
    rig: Rig, hidden: Hidden, *, repeats: int = 4, noise: float = 1.0, seconds: float = 8.0,
    seed: int = 1, sensors: Sensors = Sensors(),
) -> tuple[Run, Run]:  # fmt: skip
    """Return training run and held-out run (another excitation at seven tenths) of one bench."""
    return (
        experiment(rig, hidden, repeats=repeats, seed=seed, noise=noise, seconds=seconds,
                   sensors=sensors),
        experiment(rig, hidden, repeats=min(repeats, 2), seed=seed + 1, rms=0.7 * RMS, noise=noise,
                   seconds=seconds, sensors=sensors),
    )  # fmt: skip
