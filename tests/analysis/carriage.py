"""A carriage on a screw under its own position loop: what an electric joint's record looks like.

M q'' = gain v - Fv q' - friction - offset + hum by half-implicit steps of 0.1 ms, dry friction of
bristles that bend and slip (LuGre) and may fall with speed; nothing of it is the analysis' own.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np
from numba import njit

from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

KP, KV = 160.0, 240.0  # [1/s], [V s/m]
FINE = 10  # steps a sample
HUM = 7.3  # [Hz]
STIFFNESS, DAMPING = 1e6, 1e3  # [N/m], [N s/m] of the bristles


@dataclass(frozen=True)
class Carriage:
    """Its parameters, SI; `breakaway` is how much more friction there is at rest [N].

    `hum` is the amplitude of a force in time [N], of `HUM` [Hz].
    """

    mass: float = 95.0
    viscous: float = 200.0
    dry: float = 20.0
    offset: float = -3.0
    breakaway: float = 0.0
    hum: float = 0.0


def moves(rate: float, seconds: float, amplitude: float, wave: float) -> np.ndarray:
    """Return a reference (n,) [m] about 0.12 m: two slow waves, speeds of all sizes."""
    t = np.arange(round(seconds * rate)) / rate
    swing = np.sin(2 * np.pi * wave * t) + 0.4 * np.sin(2 * np.pi * 2.6 * wave * t + 0.5)
    return 0.12 + amplitude * (swing - swing[0]) * np.clip(t, 0.0, 1.0)


@njit(cache=True)
def _run(reference, h, gain, par, q, v):  # type: ignore[no-untyped-def]
    mass, viscous, dry, offset, breakaway, hum = par
    n = len(reference)
    position, drive = np.empty(n), np.empty(n)
    bend = 0.0
    for k in range(n):
        ahead = reference[min(k + 1, n - 1)] - reference[k]
        for fine in range(FINE):
            wanted = reference[k] + ahead * fine / FINE
            u = min(max(KV * (KP * (wanted - q) - v), -10.0), 10.0)
            if fine == 0:
                position[k], drive[k] = q, u
            level = dry + breakaway * np.exp(-((v / 0.02) ** 2))
            bend_rate = v - abs(v) * bend * STIFFNESS / max(level, 1e-9)
            friction = (STIFFNESS * bend + DAMPING * bend_rate) if level > 0 else 0.0
            bend += h * bend_rate
            force = hum * np.sin(2 * np.pi * HUM * h * (k * FINE + fine)) - offset
            v += h * (gain * u + force - viscous * v - friction) / mass
            q += h * v
    return position, drive


def record(
    rig: Rig, carriage: Carriage, reference: np.ndarray, rng: np.random.Generator, step: str,
    repeat: int = 1,
) -> Record:  # fmt: skip
    """Run it and measure with the rig's stated noise."""
    n, rate, gain = len(reference), rig.sample_rate, rig.drive_gains[0]
    par = np.array(astuple(carriage))
    position, drive = _run(reference, 1.0 / (rate * FINE), gain, par, float(reference[0]), 0.0)
    noise = rig.sensors.position.noise, rig.sensors.drive.noise
    channels = {
        "position_1": position + noise[0] * rng.standard_normal(n),
        "drive_1": drive + noise[1] * rng.standard_normal(n),
    }
    return Record(f"{step}_r{repeat}", step, (), repeat, rate, channels)


def to_and_fro(turns: int, repeats: int = 1, times: float = 10.0) -> Run:
    """Return a carriage's records, its drive several times as noisy as its rig file states."""
    rig, rng = load_rig("emps"), np.random.default_rng(1)
    reference = np.tile(moves(rig.sample_rate, 4.0, 0.05, 0.25), turns)
    noise = times * rig.sensors.drive.noise
    records = []
    for repeat in range(1, repeats + 1):
        one = record(rig, Carriage(), reference, rng, "moves", repeat)
        drive = one.channels["drive_1"] + noise * rng.standard_normal(one.samples)
        records.append(replace(one, channels={**one.channels, "drive_1": drive}))
    return Run(rig, tuple(records))
