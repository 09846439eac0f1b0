"""A tiny bench of its own: NOTES' two-joint equations typed in again, integrated by LSODA.

Nothing here comes from the analysis package: closed two-joint forms instead of the N-joint chain,
the linkage by hand, scipy's integrator. A locked joint is frozen, or wobbles as told. Sensors are
sampled with the multiplexer's skew and get white noise; there is no other imperfection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import odeint

import rig as rig_package
from rig.model.parse import parse_model
from rig.model.records import Record, Run
from rig.model.rig import Rig

Array = NDArray[np.float64]

TRUTH = {
    "M1": 4.47, "M2": 1.27, "R12": 1.37, "Fv1": 50.77, "Fv2": 4.43, "W1": 8.55, "W2": 3.30,
    "b": 233e6,
    "C_pp_1": 6.31e-7, "C_pm_1": 6.60e-7, "C_mp_1": 5.50e-7, "C_mm_1": 6.27e-7,
    "C_pp_2": 6.28e-7, "C_pm_2": 5.36e-7, "C_mp_2": 5.44e-7, "C_mm_2": 6.19e-7,
}  # fmt: skip
SUPPLY = 7e6
G0 = 9.8
NAMES = tuple(TRUTH)


def shinshu() -> Rig:
    path = Path(rig_package.__file__).parent / "shipped" / "shinshu-2dof.yaml"
    return parse_model(Rig, path.read_text(), path.name)


@dataclass(frozen=True)
class Excitation:
    """A spool voltage: sum of cosines of multiples of 1/period, plus slow centring."""

    period: float
    lines: tuple[int, ...]
    amplitude: float
    phases: tuple[float, ...]

    @classmethod
    def multisine(cls, rms: float, rng: np.random.Generator) -> Excitation:
        lines = tuple(range(3, 96, 2))
        amplitude = rms * math.sqrt(2 / len(lines))
        return cls(10.0, lines, amplitude, tuple(rng.uniform(0, 2 * math.pi, len(lines))))

    @classmethod
    def sine(cls, amplitude: float, hertz: float = 1.0) -> Excitation:
        return cls(1.0, (round(hertz),), amplitude, (math.pi / 2,))


@njit(cache=True)
def _spool(t, joint, s, waves, biases, centring):
    total = biases[joint] - centring * s
    for row in waves:
        if int(row[0]) == joint:
            total += row[2] * math.cos(row[1] * t + row[3])
    return total


@njit(cache=True)
def _piston(q, joint):
    if joint == 0:
        a, c, beta = 0.11, 0.33, q
    else:
        a, c, beta = 0.27, 0.10, q - math.pi
    length = math.sqrt(a * a + c * c - 2 * a * c * math.cos(beta))
    return length - 0.30, a * c * math.sin(beta) / length


@njit(cache=True)
def _pistons(angles, joint):
    return np.array([_piston(q, joint)[0] for q in angles])


@njit(cache=True)
def _spools(times, joint, pistons, waves, biases, centring):
    out = np.zeros(len(times))
    for k in range(len(times)):
        out[k] = _spool(times[k], joint, pistons[k], waves, biases, centring)
    return out


@njit(cache=True)
def _chamber_rates(p, joint, s, v, u, pressure_in, gains):
    cap_area, rod_area, dead = 7.0e-4, 5.4e-4, 7.9e-5 if joint == 0 else 6.3e-5
    up, down = max(pressure_in - p[0], 0.0), max(p[0], 0.0)
    rod_up, rod_down = max(pressure_in - p[1], 0.0), max(p[1], 0.0)
    bulk = gains[0]
    if u > 0:
        cap_flow = gains[1] * math.sqrt(up) * u
        rod_flow = -gains[3] * math.sqrt(rod_down) * u
    else:
        cap_flow = gains[2] * math.sqrt(down) * u
        rod_flow = -gains[4] * math.sqrt(rod_up) * u
    cap = bulk * (cap_flow - cap_area * v) / (dead + (0.0375 + s) * cap_area)
    rod = bulk * (rod_flow + rod_area * v) / (dead + (0.0375 - s) * rod_area)
    return cap, rod


@njit(cache=True)
def _rates(y, t, packed):
    """Rates of the state; all that is constant comes in one array, which is quick to pass."""
    par, locked, biases, centring = packed[:16], packed[16:18] > 0.0, packed[18:20], packed[20]
    waves = packed[21:].reshape(-1, 4)
    q1, q2, w1, w2 = y[0], y[1], y[2], y[3]
    M1, M2, R12, F1, F2, W1, W2 = par[0], par[1], par[2], par[3], par[4], par[5], par[6]
    s1, G1 = _piston(q1, 0)
    s2, G2 = _piston(q2, 1)
    c2, n2 = math.cos(q2), math.sin(q2)
    m11, m12, m22 = M1 + 2 * R12 * c2, M2 + R12 * c2, M2
    h1 = -2 * R12 * w1 * w2 * n2 - R12 * w2 * w2 * n2
    h2 = R12 * w1 * w1 * n2
    g1 = W1 * 9.8 * math.sin(q1) + W2 * 9.8 * math.sin(q1 + q2)
    g2 = W2 * 9.8 * math.sin(q1 + q2)
    r1 = G1 * (7.0e-4 * y[4] - 5.4e-4 * y[5]) - h1 - F1 * w1 - g1
    r2 = G2 * (7.0e-4 * y[6] - 5.4e-4 * y[7]) - h2 - F2 * w2 - g2
    out = np.zeros(8)
    if locked[0] and not locked[1]:
        out[3] = r2 / m22
    elif locked[1] and not locked[0]:
        out[2] = r1 / m11
    elif not locked[0]:
        det = m11 * m22 - m12 * m12
        out[2] = (m22 * r1 - m12 * r2) / det
        out[3] = (m11 * r2 - m12 * r1) / det
    if not locked[0]:
        out[0] = w1
        u = _spool(t, 0, s1, waves, biases, centring)
        out[4], out[5] = _chamber_rates(y[4:6], 0, s1, G1 * w1, u, 7e6, par[7:12])
    if not locked[1]:
        out[1] = w2
        gains = np.array([par[7], par[12], par[13], par[14], par[15]])
        u = _spool(t, 1, s2, waves, biases, centring)
        out[6], out[7] = _chamber_rates(y[6:8], 1, s2, G2 * w2, u, 7e6, gains)
    return out


def angle(piston: float, joint: int) -> float:
    """Joint angle of a piston displacement by bisection on the hand-written linkage."""
    low, high = ((0.5, 1.8), (-2.2, -0.6))[joint]
    for _ in range(60):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if _piston(mid, joint)[0] < piston else (low, mid)
    return low


@dataclass(frozen=True)
class Step:
    name: str
    locked: tuple[int, ...]  # 1-based
    start: tuple[float, float]  # piston displacements [m]


STEPS = (
    Step("step1", (1,), (0.0, 0.0)),
    Step("step2", (2,), (0.0, -0.0374)),
    Step("step3", (2,), (0.0, 0.0374)),
)


def settle(step: Step, excitation: dict[int, Excitation], truth: dict[str, float]) -> Array:
    """Start state: gravity held by the cap pressure around half the supply."""
    q = [angle(step.start[i], i) for i in (0, 1)]
    g2 = truth["W2"] * G0 * math.sin(q[0] + q[1])
    g1 = truth["W1"] * G0 * math.sin(q[0]) + g2
    state = [q[0], q[1], 0.0, 0.0]
    for joint, torque in ((0, g1), (1, g2)):
        force = torque / _piston(q[joint], joint)[1]
        rod = 3.5e6
        state += [(force + 5.4e-4 * rod) / 7.0e-4, rod]
    return np.array(state)


def simulate(
    rig: Rig,
    step: Step,
    excitation: dict[int, Excitation],
    *,
    seconds: float = 10.0,
    settle_seconds: float = 10.0,
    truth: dict[str, float] = TRUTH,
    bias: tuple[float, float] = (0.0, 0.0),
    centring: float = 0.15,
    only: tuple[str, ...] = (),
) -> dict[str, Array]:
    """Return noise-free channels after the transient, each sampled at its own skewed instant.

    Of several channels `only` some may be wanted.
    """
    waves = np.array(
        [
            (joint, 2 * math.pi * line / e.period, e.amplitude, phase)
            for joint, e in excitation.items()
            for line, phase in zip(e.lines, e.phases, strict=True)
        ]
    )
    locked = np.array([i + 1 in step.locked for i in (0, 1)])
    par = np.array([truth[name] for name in NAMES])
    n = round(seconds * rig.sample_rate)
    places = [k for k, name in enumerate(rig.channels) if not only or name in only]
    tick = np.arange(n) / rig.sample_rate + settle_seconds
    times = (tick[:, None] + rig.sensors.skew * np.array(places)).ravel()
    args = (par, locked, waves, np.array(bias), centring)
    # The integrator's first step depends on the first instant asked for: always that of a tick.
    grid = np.concatenate(([0.0, tick[0]], times))
    packed = np.concatenate((par, locked, bias, [centring], waves.ravel()))
    y = odeint(_rates, settle(step, excitation, truth), grid, (packed,), rtol=1e-8, atol=1e-8,
               hmax=0.002, mxstep=200000)[2:]  # fmt: skip
    y = y.reshape(n, len(places), 8)
    t = times.reshape(n, len(places))
    return {
        rig.channels[place]: _sense(rig.channels[place], y[:, k], t[:, k], args)
        for k, place in enumerate(places)
    }


def _sense(name: str, y: Array, t: Array, args: tuple[object, ...]) -> Array:
    if name in ("supply_pressure", "oil_temperature"):
        return np.full(len(t), SUPPLY if name == "supply_pressure" else 40.0)
    kind, joint = name.rsplit("_", 1)[0], int(name[-1]) - 1
    if kind in ("cap_pressure", "rod_pressure"):
        return y[:, (4 if kind == "cap_pressure" else 5) + 2 * joint]
    piston = _pistons(y[:, joint], joint)
    if kind == "piston":
        return piston
    if args[1][joint]:  # type: ignore[index]
        return np.zeros(len(t))
    waves, biases, centring = args[2:]
    return np.asarray(_spools(t, joint, piston, waves, biases, centring))


def centred(
    rig: Rig,
    step: Step,
    wave: dict[int, Excitation],
    *,
    seconds: float = 10.0,
    truth: dict[str, float] = TRUTH,
    centring: float = 0.3,
) -> dict[str, Array]:
    """Simulate with the bias that brings the mean stroke to the middle."""
    bias = np.zeros(2)
    pistons = tuple(f"piston_{joint + 1}" for joint in wave)
    for _ in range(2):
        clean = simulate(
            rig, step, wave, bias=tuple(bias), centring=centring, truth=truth, only=pistons
        )
        for joint in wave:
            bias[joint] -= centring * clean[f"piston_{joint + 1}"].mean()
    return simulate(
        rig, step, wave, seconds=seconds, bias=tuple(bias), centring=centring, truth=truth
    )


NOISE = {"spool": 0.2e-3, "piston": 10e-6, "cap_pressure": 5e3, "rod_pressure": 5e3,
         "supply_pressure": 5e3, "oil_temperature": 0.05}  # fmt: skip


def with_noise(
    clean: dict[str, Array], rng: np.random.Generator, scale: float = 1.0
) -> dict[str, Array]:
    """Add each sensor's white noise."""
    return {
        name: value + scale * NOISE[name.rstrip("_12")] * rng.standard_normal(len(value))
        for name, value in clean.items()
    }


def experiment(
    rig: Rig,
    excitations: dict[str, dict[int, Excitation]],
    *,
    repeats: int,
    seed: int,
    steps: tuple[Step, ...] = STEPS,
    scale: float = 1.0,
    seconds: float = 10.0,
    truth: dict[str, float] = TRUTH,
) -> Run:
    """Return a run of `repeats` noisy repeats of every step."""
    rng = np.random.default_rng(seed)
    records = []
    for step in steps:
        wave = excitations[step.name]
        clean = centred(rig, step, wave, seconds=seconds, truth=truth)
        first = next(iter(wave.values()))
        for repeat in range(1, repeats + 1):
            records.append(
                Record(
                    name=f"{step.name}_r{repeat}",
                    step=step.name,
                    locked=step.locked,
                    repeat=repeat,
                    sample_rate=rig.sample_rate,
                    channels=with_noise(clean, rng, scale),
                    period=round(first.period * rig.sample_rate),
                    lines=first.lines,
                )
            )
    return Run(rig, tuple(records), source=f"small bench, seed {seed}")


def default_excitations(seed: int, rms: float = 0.05) -> dict[str, dict[int, Excitation]]:
    """Multisines of their own for the joint that each step excites."""
    rng = np.random.default_rng(1000 + seed)
    return {
        step.name: {i - 1: Excitation.multisine(rms, rng) for i in (1, 2) if i not in step.locked}
        for step in STEPS
    }


def one_sample_shorter(run: Run) -> Run:
    """Return a run without the last sample of its records, as another run with nearly its data."""
    shorter = (
        replace(r, channels={name: x[:-1] for name, x in r.channels.items()}) for r in run.records
    )
    return replace(run, records=tuple(shorter))
