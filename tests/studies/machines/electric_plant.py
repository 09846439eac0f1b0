"""A simulated two-joint electric arm on a slope, in finer physics than the analysis knows.

Newton and Euler's recursion over two rigid links (not the chain's R_ij and W_i, so that no formula
is compared with itself), LuGre friction with presliding, a current loop with a lag, encoders and
current read-backs with noise and quantisation, and a position loop of 1 kHz that also holds a
locked joint. It makes records directly; there is no wire before it.

Glossary: theta_k absolute angle of link k, 0 along the base's own "down"; m mass [kg], r distance
of the centre of mass from the joint [m], I inertia about it [kg m^2], l length [m]. The base is
turned by `slope` [rad], so that gravity points along (cos(slope), -sin(slope)) of its frame.
Sources: Featherstone, Rigid Body Dynamics Algorithms, chapter 5; Canudas de Wit et al., A new
model for control of systems with friction, 1995.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rig.model.records import Record, Run
from rig.model.rig import ElectricRig

Array = NDArray[np.float64]

SUBSTEPS = 50  # of a sample: 20 us at 1 kHz; the bristles of the fastest motion take 60 us
LAG = 0.8e-3  # [s] of the current loop
STRIBECK_SPEED = 0.01  # [rad/s]
BREAKAWAY = 1.3  # of the sliding friction
PRESLIDING = 2e-4  # [rad] of bristle at full friction
KP, KD = (60.0, 45.0), (8.0, 5.0)  # [A/rad], [A s/rad] of the position loop
TOP = 2.0  # [Hz] highest line of the reference
PERIOD = 10.0  # [s]


@dataclass(frozen=True)
class Arm:
    """The hidden machine; friction [N m], [N m s/rad], slope [rad]."""

    mass: tuple[float, float]
    centre: tuple[float, float]
    inertia: tuple[float, float]
    length: float
    viscous: tuple[float, float]
    dry: tuple[float, float]
    slope: float

    def truth(self) -> dict[str, float]:
        """Return the parameters of the chain (names of `rig.model.parameters`), Fc and slope."""
        (m1, m2), (r1, r2), (i1, i2), l1 = self.mass, self.centre, self.inertia, self.length
        outer = i2 + m2 * r2**2
        return {
            "M1": i1 + m1 * r1**2 + m2 * l1**2 + outer,
            "M2": outer,
            "R12": m2 * l1 * r2,
            "Fv1": self.viscous[0],
            "Fv2": self.viscous[1],
            "W1": m1 * r1 + m2 * l1,
            "W2": m2 * r2,
            "base_inclination": self.slope,
            "Fc1": self.dry[0],
            "Fc2": self.dry[1],
        }


def draw_arm(rng: np.random.Generator, slope: float | None = None) -> Arm:
    """Return an arm about the shipped rig's design, each value drawn within 15 %.

    `slope` [rad] is drawn within 20 degrees, at least 3 off level, where not given.
    """

    def near(value: float) -> float:
        return value * float(rng.uniform(0.85, 1.15))

    drawn = float(rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(3.0, 20.0)))
    return Arm(
        mass=(near(5.0), near(2.4)),
        centre=(near(0.26), near(0.2)),
        inertia=(near(0.11), near(0.035)),
        length=0.5,
        viscous=(near(1.8), near(0.55)),
        dry=(near(0.6), near(0.25)),
        slope=drawn if slope is None else slope,
    )


@njit(cache=True)
def _torques(q, qd, qdd, g, arm):  # type: ignore[no-untyped-def]
    """Return the joint torques (2,) that the motion needs, without friction."""
    m1, m2, r1, r2, i1, i2, l1, slope = arm
    t1, t2 = q[0], q[0] + q[1]
    w1, w2 = qd[0], qd[0] + qd[1]
    a1, a2 = qdd[0], qdd[0] + qdd[1]
    gx, gy = g * math.cos(slope), -g * math.sin(slope)
    c1, s1, c2, s2 = math.cos(t1), math.sin(t1), math.cos(t2), math.sin(t2)
    # Accelerations of centre 1, elbow and centre 2, along and across the base's "down".
    ax1, ay1 = r1 * (-s1 * a1 - c1 * w1 * w1), r1 * (c1 * a1 - s1 * w1 * w1)
    ex, ey = l1 * (-s1 * a1 - c1 * w1 * w1), l1 * (c1 * a1 - s1 * w1 * w1)
    ax2, ay2 = ex + r2 * (-s2 * a2 - c2 * w2 * w2), ey + r2 * (c2 * a2 - s2 * w2 * w2)
    fx2, fy2 = m2 * (ax2 - gx), m2 * (ay2 - gy)
    fx1, fy1 = m1 * (ax1 - gx), m1 * (ay1 - gy)
    n2 = i2 * a2 + r2 * (c2 * fy2 - s2 * fx2)
    n1 = i1 * a1 + r1 * (c1 * fy1 - s1 * fx1) + n2 + l1 * (c1 * fy2 - s1 * fx2)
    return np.array([n1, n2])


@njit(cache=True)
def _acceleration(q, qd, torque, g, arm):  # type: ignore[no-untyped-def]
    zero, still = np.zeros(2), np.zeros(2)
    bias = _torques(q, qd, zero, g, arm)
    first = _torques(q, still, np.array([1.0, 0.0]), 0.0, arm)
    second = _torques(q, still, np.array([0.0, 1.0]), 0.0, arm)
    free = torque - bias
    det = first[0] * second[1] - second[0] * first[1]
    return np.array(
        [
            (free[0] * second[1] - second[0] * free[1]) / det,
            (first[0] * free[1] - free[0] * first[1]) / det,
        ]
    )


@njit(cache=True)
def _run(reference, q, gains, arm, friction, g, rate, noise, quantum, limit):  # type: ignore[no-untyped-def]
    """Return measured positions and currents (n, 2) under the position loop."""
    n = len(reference)
    positions, currents = np.empty((n, 2)), np.empty((n, 2))
    qd, z, current, command = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    last, rate_seen = q.copy(), np.zeros(2)
    h = 1.0 / (rate * SUBSTEPS)
    for k in range(n):
        for i in range(2):
            seen = q[i] + noise[k, i]
            seen = quantum[0] * round(seen / quantum[0])
            positions[k, i] = seen
            raw = current[i] + noise[k, 2 + i]
            currents[k, i] = quantum[1] * round(raw / quantum[1])
            rate_seen[i] += 0.2 * ((seen - last[i]) * rate - rate_seen[i])
            last[i] = seen
            wanted = KP[i] * (reference[k, i] - seen) - KD[i] * rate_seen[i]
            command[i] = min(max(wanted, -limit), limit)
        for _ in range(SUBSTEPS):
            torque = np.zeros(2)
            for i in range(2):
                current[i] += h / LAG * (command[i] - current[i])
                viscous, dry = friction[0, i], friction[1, i]
                stiffness = dry / PRESLIDING
                level = dry * (1.0 + (BREAKAWAY - 1.0) * math.exp(-((qd[i] / STRIBECK_SPEED) ** 2)))
                bent = qd[i] - stiffness * abs(qd[i]) / level * z[i]
                # Damping of the bristles fades with speed, or it would add to the viscous part.
                damping = 0.3 * math.exp(-((qd[i] / STRIBECK_SPEED) ** 2))
                drag = stiffness * z[i] + damping * bent + viscous * qd[i]
                z[i] += h * bent
                torque[i] = gains[i] * current[i] - drag
            qdd = _acceleration(q, qd, torque, g, arm)
            qd += h * qdd
            q += h * qd
    return positions, currents


def reference(
    rng: np.random.Generator, rate: float, seconds: float, excited: Sequence[int]
) -> Array:
    """Return a position reference (n, 2) [rad]: random-phase multisine on the excited joints.

    A held joint stays at its mean place; lines up to `TOP`, amplitudes falling with frequency.
    """
    t = np.arange(round(seconds * rate)) / rate
    out = np.tile(np.array([0.25, 0.5]), (len(t), 1))
    for i in excited:
        lines = np.arange(1 + i, TOP * PERIOD + 1, 2)  # odd ones and even ones
        phase = rng.uniform(0, 2 * np.pi, len(lines))
        weight = 1.0 / (1.0 + lines / (0.8 * PERIOD))
        wave = (weight * np.cos(2 * np.pi * np.outer(t, lines / PERIOD) + phase)).sum(axis=1)
        out[:, i] += (0.7, 0.9)[i] * wave / np.abs(wave).max()
    return out


def _measure(
    rig: ElectricRig, arm: Arm, wave: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    sensors = rig.sensors
    spread = np.repeat([sensors.position.noise, sensors.drive.noise], 2)
    noise = spread * rng.standard_normal((len(wave), 4))
    quantum = np.array(
        [(s.range[1] - s.range[0]) / ((1 << s.bits) - 1) for s in (sensors.position, sensors.drive)]
    )
    machine = np.array([*arm.mass, *arm.centre, *arm.inertia, arm.length, arm.slope])
    gains = np.array([joint.drive.gain for joint in rig.joints])
    friction = np.array([arm.viscous, arm.dry])
    limit = rig.joints[0].limits.drive
    positions, currents = _run(
        wave, np.array([0.0, 0.0]) + wave[0], gains, machine, friction, rig.gravity,
        rig.sample_rate, noise, quantum, limit,
    )  # fmt: skip
    return positions, currents


def records(
    rig: ElectricRig, arm: Arm, rng: np.random.Generator, *, step: str = "both", repeats: int = 4
) -> Run:
    """Return a run of one step: `both` joints, or joint `one` or `two` alone, the other held.

    The reference is periodic; the first period is left out, then each period is a repeat.
    """
    excited = {"both": (0, 1), "one": (0,), "two": (1,)}[step]
    rate = rig.sample_rate
    n = round(PERIOD * rate)
    wave = reference(rng, rate, PERIOD, excited)
    positions, currents = _measure(rig, arm, np.tile(wave, (repeats + 1, 1)), rng)
    locked = tuple(i + 1 for i in range(2) if i not in excited)
    found = []
    for repeat in range(1, repeats + 1):
        part = slice(repeat * n, (repeat + 1) * n)
        channels = {}
        for i in range(2):
            channels[f"position_{i + 1}"] = positions[part, i].copy()
            channels[f"drive_{i + 1}"] = currents[part, i].copy()
        name = f"{step}_r{repeat}"
        found.append(Record(name, step, locked, repeat, rate, channels, period=n))
    return Run(rig, tuple(found), source=f"simulated electric arm, {step}")
