"""Joint 2 of the seed bench with one thing wrong, typed in again and integrated by LSODA.

Nothing here comes from the analysis package: NOTES' equations of joint 2 with joint 1 standing at
mid-stroke, the linkage by hand, every effect in time (bristle and spool lag are states, the port
pressures are found by bisection), scipy's integrator. Each channel is sampled at its own instant,
which is how a channel comes to lag; gains and offsets are put on afterwards, noise last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import odeint

from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.analysis.small_bench import NOISE, TRUTH, Excitation, angle

Array = NDArray[np.float64]

FLOW = 11.7e-3 / 60  # the pump's [m^3/s]
P0 = 101_325.0
NAMES = (
    "Fc", "Fs", "v_stribeck", "fall", "F_ext", "F_ret", "k_friction", "k_seal", "k_rod",
    "presliding", "stiffening", "inclination", "k_spring", "rest", "T_offset",
    "w_ahead", "w_astern", "u_null", "w_underlap", "tau_spool", "w_tank",
    "c_internal", "c_cap", "c_rod", "dp_supply", "p_tank", "p_back",
    "alpha_air", "V_cap", "V_rod", "m_payload", "hose",
)  # fmt: skip
(
    FC, FS, VS, FALL, FE, FR, KF, KD, KR, DELTA, STIFFENING, INCLINATION, SPRING, REST, TORQUE,
    AHEAD, ASTERN, NULL, UNDERLAP, TAU, TO_TANK, C_INT, C_CAP, C_ROD, SAG, TANK, BACK, AIR, V_CAP,
    V_ROD, LOAD, HOSE,
) = range(len(NAMES))  # fmt: skip
SHAPES = {"presliding": 40e-6, "v_stribeck": 0.03, "fall": 2.0, "rest": -1.35}
NAMES_1 = ("M2", "Fv2", "W2", "b", "C_pp_2", "C_pm_2", "C_mp_2", "C_mm_2")
END = 11 + len(NAMES)  # of what is wrong, in what is passed to the integrator
CHANNELS = ("spool", "piston", "cap_pressure", "rod_pressure")


@njit(cache=True)
def _command(t, s, wave, bias, centring):
    total = bias - centring * s
    for row in wave:
        total += row[0] * math.cos(row[1] * t + row[2])
    return total


@njit(cache=True)
def _linkage(q):
    a, c, beta = 0.27, 0.10, q - math.pi
    length = math.sqrt(a * a + c * c - 2 * a * c * math.cos(beta))
    return length - 0.30, a * c * math.sin(beta) / length


@njit(cache=True)
def _pistons(angles):
    return np.array([_linkage(q)[0] for q in angles])


@njit(cache=True)
def _commands(times, pistons, wave, bias, centring):
    out = np.zeros(len(times))
    for k in range(len(times)):
        out[k] = _command(times[k], pistons[k], wave, bias, centring)
    return out


@njit(cache=True)
def _edges(x, e):
    """Openings of the edges that serve a positive and a negative spool."""
    x -= e[NULL]
    ahead, astern = max(x, 0.0), max(-x, 0.0)
    if e[AHEAD] > 0.0 or e[ASTERN] > 0.0:
        ahead, astern = max(x - e[AHEAD], 0.0), max(-x - e[ASTERN], 0.0)
    if e[UNDERLAP] > 0.0:
        ahead, astern = max(x + e[UNDERLAP], 0.0), max(e[UNDERLAP] - x, 0.0)
    return ahead, astern


@njit(cache=True)
def _through(gain, opening, drop):
    return gain * opening * math.copysign(math.sqrt(abs(drop)), drop)


@njit(cache=True)
def _ports(cap, rod, ahead, astern, par, e):
    """Supply and tank pressure at the valve, by bisection on the flow through the line."""
    p_s, p_t = 7e6, e[TANK]
    if e[SAG] > 0.0:
        low, high = 0.0, 2e-3
        for _ in range(60):
            Q = 0.5 * (low + high)
            p = 7e6 - e[SAG] * (Q / FLOW) ** 2
            more = _through(par[4], ahead, p - cap) + _through(par[7], astern, p - rod) > Q
            low, high = (Q, high) if more else (low, Q)
        p_s = 7e6 - e[SAG] * (low / FLOW) ** 2
    if e[BACK] > 0.0:
        low, high = 0.0, 2e-3
        for _ in range(60):
            Q = 0.5 * (low + high)
            p = e[TANK] + e[BACK] * (Q / FLOW) ** 2
            more = _through(par[6], ahead, rod - p) + _through(par[5], astern, cap - p) > Q
            low, high = (Q, high) if more else (low, Q)
        p_t = e[TANK] + e[BACK] * (low / FLOW) ** 2
    return p_s, p_t


@njit(cache=True)
def _friction(v, cap, rod, deflection, e):
    z = deflection / e[DELTA]
    level = (
        e[FC]
        + e[FS] * math.exp(-(abs(v / e[VS]) ** e[FALL]))
        + e[KF] * (cap + rod)
        + e[KD] * abs(cap - rod)
        + e[KR] * rod
    )
    level += e[FE] if z > 0 else e[FR]
    rate = 0.0 if level == 0.0 else v - abs(v) * deflection / e[DELTA]
    return level * z, (1.0 + e[STIFFENING] * abs(v)) * rate


@njit(cache=True)
def _rates(y, t, packed):
    """Rates of the state; all that is constant comes in one array, which is quick to pass."""
    q1, bias, centring, par, e = packed[0], packed[1], packed[2], packed[3:11], packed[11:END]
    wave = packed[END:].reshape(-1, 3)
    q, w, cap, rod = y[0], y[1], y[2], y[3]
    s, G = _linkage(q)
    v = G * w
    u = _command(t, s, wave, bias, centring)
    lag = (u - y[5]) / e[TAU] if e[TAU] > 0.0 else 0.0
    ahead, astern = _edges(y[5] if e[TAU] > 0.0 else u, e)
    p_s, p_t = _ports(cap, rod, ahead, astern, par, e)
    leak = e[C_INT] * (cap - rod)
    later, earlier = max(e[TO_TANK], 0.0), max(-e[TO_TANK], 0.0)
    from_supply = max(ahead - earlier, 0.0), max(astern - earlier, 0.0)
    to_tank = max(ahead - later, 0.0), max(astern - later, 0.0)
    into_cap = _through(par[4], from_supply[0], p_s - cap) - _through(par[5], to_tank[1], cap - p_t)
    into_rod = _through(par[7], from_supply[1], p_s - rod) - _through(par[6], to_tank[0], rod - p_t)
    into_cap -= leak + e[C_CAP] * (cap - p_t)
    into_rod += leak - e[C_ROD] * (rod - p_t)
    soft_cap = 1 / par[3] + e[AIR] * P0 / (cap + P0) ** 2
    soft_rod = 1 / par[3] + e[AIR] * P0 / (rod + P0) ** 2
    volume_cap = 6.3e-5 + e[V_CAP] + (0.0375 + s) * 7.0e-4
    volume_rod = 6.3e-5 + e[V_ROD] + (0.0375 - s) * 5.4e-4
    # Two hoses whose walls give like so much oil without pressure, e times less at each 5 MPa.
    volume_cap += e[HOSE] * math.exp(-cap / 5e6)
    volume_rod += e[HOSE] * math.exp(-rod / 5e6)
    force, deflecting = _friction(v, cap, rod, y[4], e)
    torque = G * (7.0e-4 * cap - 5.4e-4 * rod - force) - par[1] * w + e[TORQUE]
    torque -= (par[2] + 0.5 * e[LOAD]) * 9.8 * math.sin(q1 + q + e[INCLINATION])
    torque -= e[SPRING] * (q - e[REST])
    return np.array([
        w, torque / (par[0] + 0.25 * e[LOAD]),
        (into_cap - 7.0e-4 * v) / (volume_cap * soft_cap),
        (into_rod + 5.4e-4 * v) / (volume_rod * soft_rod),
        deflecting, lag,
    ])  # fmt: skip


@dataclass(frozen=True)
class Wrong:
    """What is wrong: parameters by NAMES, and delay [s], gain, offset of single channels."""

    plant: dict[str, float]
    delay: dict[str, float]
    gain: dict[str, float]
    offset: dict[str, float]

    @classmethod
    def of(cls, **values: float) -> Wrong:
        """Sort keywords: `delay_piston` and the like are the sensors'."""
        sensors: dict[str, dict[str, float]] = {"delay": {}, "gain": {}, "offset": {}}
        plant = {}
        for name, value in values.items():
            kind, _, channel = name.partition("_")
            if kind in sensors and (channel in CHANNELS or channel == "supply_pressure"):
                sensors[kind][channel] = value
            else:
                plant[name] = value
        return cls(plant, **sensors)

    def array(self) -> Array:
        return np.array([self.plant.get(name, SHAPES.get(name, 0.0)) for name in NAMES])


RIGHT = Wrong.of()


def excitation(rms: float, seed: int, top: int = 38) -> Array:
    """Rows of amplitude, angular frequency, phase: odd lines of 0.25 Hz."""
    rng = np.random.default_rng(seed)
    lines = np.arange(1, top, 2)
    phases = rng.uniform(0, 2 * np.pi, len(lines))
    weight = 1 / np.sqrt(lines)
    amplitude = rms * np.sqrt(2) * weight / np.linalg.norm(weight)
    return np.column_stack((amplitude, 2 * np.pi * 0.25 * lines, phases))


def channels(rig: Rig, wrong: Wrong, wave: Array, seconds: float = 8.0) -> dict[str, Array]:
    """Return noise-free channels after the transient, centred by a bias found on a first go."""
    bias = 0.0
    for _ in range(3):
        clean = _simulated(rig, RIGHT if _ == 0 else wrong, wave, bias, 4.0, ("piston",))
        bias -= 0.3 * float(clean["piston_2"].mean())
    return _simulated(rig, wrong, wave, bias, seconds)


def _simulated(
    rig: Rig, wrong: Wrong, wave: Array, bias: float, seconds: float,
    kinds: tuple[str, ...] = CHANNELS,
) -> dict[str, Array]:  # fmt: skip
    centring, settle = 0.3, 4.0
    q1 = angle(0.0, 0)
    par = np.array([TRUTH[name] for name in NAMES_1])
    packed = np.concatenate(([q1, bias, centring], par, wrong.array(), wave.ravel()))
    n = round(seconds * rig.sample_rate)
    tick = np.arange(n) / rig.sample_rate + settle
    instants = {}
    for kind in CHANNELS:
        late = wrong.delay.get(kind, 0.0) - rig.sensors.skew * rig.channels.index(f"{kind}_2")
        instants[kind] = tick - late
    # The integrator's first step depends on the first instant asked for.
    first = min(times[0] for times in instants.values())
    times, back = np.unique(np.concatenate([instants[k] for k in kinds]), return_inverse=True)
    q2 = angle(0.0, 1)
    G = _linkage(q2)[1]
    hold = TRUTH["W2"] * 9.8 * math.sin(q1 + q2) / G
    start = [q2, 0.0, (hold + 5.4e-4 * 3.5e6) / 7.0e-4, 3.5e6, 0.0, 0.0]
    grid = np.concatenate(([0.0, first], times))
    y = odeint(_rates, start, grid, (packed,), rtol=1e-8, atol=1e-9,
               hmax=0.002, mxstep=200000)[2:]  # fmt: skip
    y = y[back].reshape(len(kinds), n, 6)
    supply = wrong.gain.get("supply_pressure", 1.0) * 7e6 + wrong.offset.get("supply_pressure", 0)
    out = {
        "spool_1": np.zeros(n), "piston_1": np.zeros(n),
        "cap_pressure_1": np.full(n, 3.5e6), "rod_pressure_1": np.full(n, 3.5e6),
        "supply_pressure": np.full(n, supply), "oil_temperature": np.full(n, 40.0),
    }  # fmt: skip
    for k, kind in enumerate(kinds):
        piston = _pistons(y[k][:, 0])
        if kind == "spool":
            x = _commands(instants[kind], piston, wave, bias, centring)
        else:
            x = piston if kind == "piston" else y[k][:, 2 if kind == "cap_pressure" else 3]
        out[f"{kind}_2"] = wrong.gain.get(kind, 1.0) * x + wrong.offset.get(kind, 0.0)
    return out


def record(rig: Rig, clean: dict[str, Array], name: str, seed: int, noise: float = 1.0) -> Record:
    """Return a record of step 1 (joint 1 locked) with white noise on every sensor."""
    rng = np.random.default_rng(seed)
    noisy = {
        key: x + noise * NOISE[key.rstrip("_12")] * rng.standard_normal(len(x))
        for key, x in clean.items()
    }
    lines = tuple(range(1, 38, 2))
    return Record(name, "step1", (1,), 1, rig.sample_rate, noisy, period=4000, lines=lines)


def run(rig: Rig, wrong: Wrong, rms: float, seed: int) -> Run:
    """Return one record of 8 s."""
    clean = channels(rig, wrong, excitation(rms, seed))
    return Run(rig, (record(rig, clean, "step1_r1", seed),), f"one joint, seed {seed}")


__all__ = ["RIGHT", "Excitation", "Wrong", "channels", "excitation", "record", "run"]
