"""A carriage on a screw under its own position loop: what an electric joint's record looks like.

M q'' = gain v - Fv q' - friction - offset by half-implicit steps of 0.1 ms, dry friction that holds
(Karnopp) and that may fall with speed; nothing of it is shared with the analysis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.model.electric import drive_gains
from rig.model.records import Record
from rig.model.rig import Rig

KP, KV = 160.0, 240.0  # [1/s], [V s/m]
FINE = 10  # steps a sample


@dataclass(frozen=True)
class Carriage:
    """Its parameters, SI; `breakaway` is how much more friction there is at rest [N]."""

    mass: float = 95.0
    viscous: float = 200.0
    dry: float = 20.0
    offset: float = -3.0
    breakaway: float = 0.0


def moves(rate: float, seconds: float, amplitude: float, wave: float) -> np.ndarray:
    """Return a reference (n,) [m] about 0.12 m: two slow waves, speeds of all sizes."""
    t = np.arange(round(seconds * rate)) / rate
    swing = np.sin(2 * np.pi * wave * t) + 0.4 * np.sin(2 * np.pi * 2.6 * wave * t + 0.5)
    return 0.12 + amplitude * (swing - swing[0]) * np.clip(t, 0.0, 1.0)


def record(
    rig: Rig, carriage: Carriage, reference: np.ndarray, rng: np.random.Generator, step: str,
    repeat: int = 1,
) -> Record:  # fmt: skip
    """Run it and measure with the rig's stated noise."""
    n, rate, gain = len(reference), rig.sample_rate, drive_gains(rig)[0]
    h = 1.0 / (rate * FINE)
    position, drive = np.empty(n), np.empty(n)
    q, v = float(reference[0]), 0.0
    for k in range(n):
        u = float(np.clip(KV * (KP * (reference[k] - q) - v), -10.0, 10.0))
        position[k], drive[k] = q, u
        for _ in range(FINE):
            level = carriage.dry + carriage.breakaway * np.exp(-((v / 0.02) ** 2))
            free = v + h * (gain * u - carriage.offset - carriage.viscous * v) / carriage.mass
            slowed = abs(free) - h * level / carriage.mass
            v = float(np.sign(free)) * slowed if slowed > 0 else 0.0
            q += h * v
    noise = rig.sensors.position.noise, rig.sensors.drive.noise
    channels = {
        "position_1": position + noise[0] * rng.standard_normal(n),
        "drive_1": drive + noise[1] * rng.standard_normal(n),
    }
    return Record(f"{step}_r{repeat}", step, (), repeat, rate, channels)
