"""Scenarios drawn by a seed: the hidden effects of a bench.

A draw is none, one or two effects of the simulator's list, or one with parts that no short formula
describes (a spring that hardens steeply, seals as soft as a backlash). Places are drawn uniformly,
sizes log-uniformly over realistic ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from hil_sim.effects import CLASSES
from hil_sim.effects.base import PlantEffect, Size
from hil_sim.effects.friction import CoulombFriction
from hil_sim.effects.mechanics import JointSpring
from hil_sim.scenario.file import Scenario, check_fits
from rig.model import channels as ch
from rig.model.rig import Rig

RANDOM: Final = "random"  # in place of a file's name on a command line
STREAM: Final = 2  # of a bench's seed; 0 and 1 are the plant's own
NONE, ONE, TWO, NO_FORMULA = "none", "one", "two", "strange"
SHARES: Final[Mapping[str, float]] = {NONE: 0.2, ONE: 0.4, TWO: 0.25, NO_FORMULA: 0.15}

# Effects that no short formula describes: name, and keys with their ranges [SI].
NO_FORMULA_EFFECTS: Final[tuple[tuple[type[PlantEffect], Mapping[str, Size]], ...]] = (
    (JointSpring, {"stiffness": (25.0, 40.0), "hardening": (30.0, 50.0)}),
    (CoulombFriction, {"force": (90.0, 150.0), "presliding": (3e-3, 5e-3)}),
)


def draw(rig: Rig, seed: int) -> Scenario:
    """Return the scenario hidden by a bench of this seed; equal seeds return equal scenarios."""
    rng = np.random.default_rng([seed, STREAM])
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    effects: list[dict[str, Any]] = []
    if kind == NO_FORMULA:
        effect_class, sizes = NO_FORMULA_EFFECTS[int(rng.integers(len(NO_FORMULA_EFFECTS)))]
        effects = [_effect(effect_class, sizes, rig, rng)]
    elif kind != NONE:
        count = 1 if kind == ONE else 2
        drawable = [effect for effect in CLASSES if effect.drawn]
        chosen = [drawable[int(i)] for i in rng.choice(len(drawable), size=count, replace=False)]
        effects = [_effect(effect, effect.sizes, rig, rng) for effect in chosen]
    scenario = Scenario.model_validate({"description": f"drawn: {kind}", "effects": effects})
    check_fits(scenario, rig)
    return scenario


def _effect(
    kind: type[PlantEffect], sizes: Mapping[str, Size], rig: Rig, rng: np.random.Generator
) -> dict[str, Any]:
    out: dict[str, Any] = {"name": kind.effect_name()}
    joint = int(rng.integers(1, len(rig.joints) + 1))
    if kind.drawn_at == "pressure":
        out["channel"] = ch.channel(str(rng.choice([ch.CAP, ch.ROD])), joint)
    elif kind.drawn_at == "bench":
        out["where"] = "bench"
    else:
        side = f" {rng.choice(['cap', 'rod'])}" if kind.drawn_at == "chamber" else ""
        out["where"] = f"joint {joint}{side}"
    for key, (least, most) in sizes.items():
        size = math.exp(rng.uniform(math.log(least), math.log(most)))
        sign = -1.0 if key in kind.signed and rng.random() < 0.5 else 1.0
        out[key] = sign * size
    return out
