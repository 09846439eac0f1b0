"""Scenarios drawn by a seed: what is wrong with a bench that nobody has told anything about.

A draw is none, one or two effects of the simulator's list, or one that is made of its parts in a
way no short formula describes (a spring that hardens steeply, seals as soft as a backlash).
Places are even, sizes even in their logarithm over what such a bench may show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hil_sim.scenario.file import Scenario, check_fits
from rig.model import channels as ch
from rig.model.rig import Rig

RANDOM: Final = "random"  # what a command line says instead of a file
STREAM: Final = 2  # of a bench's seed; 0 and 1 are the plant's own
NONE, ONE, TWO, STRANGE = "none", "one", "two", "strange"
SHARES: Final[Mapping[str, float]] = {NONE: 0.2, ONE: 0.4, TWO: 0.25, STRANGE: 0.15}

Size = tuple[float, float]  # smallest and largest, SI


@dataclass(frozen=True)
class Kind:
    """An effect that may be drawn: where it can be, keys with their ranges [SI].

    `place` is ``bench``, ``joint``, ``chamber`` or ``pressure`` (a pressure's channel); keys in
    `signed` are drawn either way.
    """

    name: str
    place: str
    sizes: Mapping[str, Size]
    signed: tuple[str, ...] = ()


KINDS: Final = (
    Kind("coulomb_friction", "joint", {"force": (20.0, 120.0)}),
    Kind("stribeck_friction", "joint", {"force": (40.0, 120.0), "speed": (0.01, 0.04)}),
    Kind("asymmetric_friction", "joint", {"extending": (40.0, 120.0), "retracting": (5.0, 20.0)}),
    Kind("pressure_dependent_friction", "joint", {"coefficient": (6e-6, 3e-5)}),
    Kind("base_inclination", "bench", {"angle": (0.017, 0.07)}, ("angle",)),
    Kind("payload", "bench", {"mass": (0.5, 6.5)}),
    Kind("joint_spring", "joint", {"stiffness": (30.0, 150.0)}),
    Kind("torque_offset", "joint", {"torque": (3.0, 15.0)}, ("torque",)),
    Kind("valve_deadband", "joint", {"width": (4e-3, 20e-3)}),
    Kind("underlap_leakage", "joint", {"width": (4e-3, 15e-3)}),
    Kind("spool_offset", "joint", {"voltage": (2e-3, 10e-3)}, ("voltage",)),
    Kind("spool_lag", "joint", {"time": (1e-3, 5e-3)}),
    Kind("internal_leakage", "joint", {"conductance": (5e-13, 3e-12)}),
    Kind("external_leakage", "chamber", {"conductance": (5e-13, 3e-12)}),
    Kind("supply_sag", "bench", {"line_drop": (0.3e6, 1e6)}),
    Kind("tank_pressure", "bench", {"pressure": (0.1e6, 0.4e6)}),
    Kind("entrained_air", "bench", {"fraction": (3e-3, 3e-2)}),
    Kind("dead_volume", "chamber", {"volume": (20e-6, 100e-6)}),
    Kind("channel_delay", "pressure", {"time": (1e-3, 6e-3)}),
    Kind("sensor_gain", "pressure", {"gain": (1.01, 1.08)}),
    Kind("sensor_offset", "pressure", {"offset": (0.03e6, 0.2e6)}, ("offset",)),
)
STRANGERS: Final = (
    Kind("joint_spring", "joint", {"stiffness": (25.0, 40.0), "hardening": (30.0, 50.0)}),
    Kind("coulomb_friction", "joint", {"force": (90.0, 150.0), "presliding": (3e-3, 5e-3)}),
)


def draw(rig: Rig, seed: int) -> Scenario:
    """Return the scenario that a bench of this seed hides; the same seed hides the same."""
    rng = np.random.default_rng([seed, STREAM])
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    effects: list[dict[str, Any]] = []
    if kind == STRANGE:
        effects = [_effect(STRANGERS[int(rng.integers(len(STRANGERS)))], rig, rng)]
    elif kind != NONE:
        count = 1 if kind == ONE else 2
        chosen = rng.choice(len(KINDS), size=count, replace=False)
        effects = [_effect(KINDS[int(i)], rig, rng) for i in chosen]
    scenario = Scenario.model_validate({"description": f"drawn: {kind}", "effects": effects})
    check_fits(scenario, rig)
    return scenario


def _effect(kind: Kind, rig: Rig, rng: np.random.Generator) -> dict[str, Any]:
    out: dict[str, Any] = {"name": kind.name}
    joint = int(rng.integers(1, len(rig.joints) + 1))
    if kind.place == "pressure":
        out["channel"] = ch.channel(str(rng.choice([ch.CAP, ch.ROD])), joint)
    elif kind.place == "bench":
        out["where"] = "bench"
    else:
        side = f" {rng.choice(['cap', 'rod'])}" if kind.place == "chamber" else ""
        out["where"] = f"joint {joint}{side}"
    for key, (least, most) in kind.sizes.items():
        size = math.exp(rng.uniform(math.log(least), math.log(most)))
        sign = -1.0 if key in kind.signed and rng.random() < 0.5 else 1.0
        out[key] = sign * size
    return out
