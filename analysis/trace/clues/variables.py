"""Variables of a joint that a residual may depend on, and factors of their curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.effects.contact import contact_state
from analysis.signals.conditioning import Signals
from analysis.trace.settings import CLUES
from rig.model import channels as ch
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Factor:
    """A factor of a curve: the `variable` that it is computed from, and the factor in `words`."""

    variable: str
    words: str


def factors(equation: str) -> dict[str, Factor]:
    """Return the factors of an equation's curves by name."""
    kind, number = equation.rsplit("_", 1)
    velocity = f"velocity_{number}"
    if kind == "torque":
        return {
            "direction": Factor(velocity, f"the direction of {velocity}"),
            "memory": Factor(velocity, f"the direction of {velocity} with memory"),
            velocity: Factor(velocity, velocity),
        }
    difference, spool = f"pressure_difference_{number}", ch.channel(ch.SPOOL, int(number))
    return {name: Factor(name, name) for name in (difference, spool)}


def factor_of(name: str, signals: Signals, joint: int, travel: float) -> Array:
    """Return the factor `direction` or `memory` (n,); `travel` [m, rad] is the joint's largest."""
    if name == "direction":
        speed = signals.sd[:, joint]
        rms = float(np.sqrt(np.mean(speed**2)))
        return np.asarray(np.tanh(speed / max(CLUES.direction_speed * rms, 1e-12)))
    place = np.ascontiguousarray(signals.s[:, joint])
    return np.asarray(contact_state(place, max(CLUES.direction_memory * travel, 1e-12)))


def variables(rig: Rig, signals: Signals, joint: int) -> dict[str, Array]:
    """Return the variables (n,) that a residual of a joint (0-based) may depend on, by name."""
    i, cap, rod = joint, signals.p_cap[:, joint], signals.p_rod[:, joint]
    if rig.electric:
        return {
            ch.channel(ch.POSITION, i + 1): signals.q[:, i],
            f"velocity_{i + 1}": signals.qd[:, i],
            f"acceleration_{i + 1}": signals.qdd[:, i],
            ch.channel(ch.DRIVE, i + 1): signals.u[:, i],
            "time": signals.t,
        }
    return {
        ch.channel(ch.PISTON, i + 1): signals.s[:, i],
        f"velocity_{i + 1}": signals.sd[:, i],
        f"acceleration_{i + 1}": np.gradient(signals.sd[:, i]) * signals.rate,
        ch.channel(ch.CAP, i + 1): cap,
        ch.channel(ch.ROD, i + 1): rod,
        f"pressure_difference_{i + 1}": cap - rod,
        ch.channel(ch.SPOOL, i + 1): signals.u[:, i],
        ch.SUPPLY: signals.p_s,
        ch.TEMPERATURE: signals.temperature,
        "time": signals.t,
    }
