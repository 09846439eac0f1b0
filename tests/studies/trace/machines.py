"""Other machines for the trace's study: relatives of the shipped rigs, drawn by a seed.

One to three joints, cylinders, volumes, gains, masses, oil and supply apart from the shipped ones,
and true parameters that lie apart from the rig file's nominal ones, as a real machine's do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from hil_sim.scenario.file import Scenario
from hil_sim.scenario.random_draw import NO_FORMULA, draw
from protocols.files.schema import Protocol
from rig.model.parts import Joint
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.studies.trace.cases import NOISE, NONE, OUTSIDE, PAIR, SINGLE, Case, place_of

FAMILIES: Final = ("boom-1dof", "shinshu-2dof", "digger-3dof")
SPREAD: Final = 0.2  # standard deviation of the logarithm of sizes between machines
UNKNOWN: Final = 0.08  # of the logarithm of a true parameter about the nominal one
SUPPLY: Final = (5e6, 12e6)  # [Pa]
STREAM: Final = 11  # of a case's seed; scenario and noise draw from others
# A load that never changes is mass of the last link to any record: no residual tells it.
ABSORBED: Final = ("payload",)
MOVES: Final = {"joint_spring": "piston acceleration", "coulomb_friction": "piston velocity"}


def machine(seed: int) -> Rig:
    """Return the rig of a seed: nominal parameters and rig file of one machine."""
    rng = np.random.default_rng([seed, STREAM])
    base = load_rig(FAMILIES[int(rng.integers(len(FAMILIES)))])
    pressure = float(np.exp(rng.uniform(*np.log(SUPPLY))))
    mass, oil = _factor(rng, SPREAD), _factor(rng, 2 * SPREAD)
    joints, areas = [], []
    for joint in base.joints:
        area = _factor(rng, SPREAD)
        joints.append(_joint(joint, area, pressure, rng))
        areas.append(area)
    # A link that the supply could not lift would never leave its end of stroke.
    mass *= float(np.mean(areas)) * pressure / base.supply.pressure
    nominal = {
        name: value * _scaled(name, mass, oil, areas, pressure / base.supply.pressure)
        for name, value in base.nominal.items()
    }
    top = 1.4 * pressure
    sensors = base.sensors.model_copy(
        update={
            name: getattr(base.sensors, name).model_copy(update={"range": (-0.1e6, top)})
            for name in ("chamber_pressure", "supply_pressure")
        }
    )
    supply = base.supply.model_copy(
        update={"pressure": pressure, "flow": base.supply.flow * float(np.max(areas))}
    )
    return base.model_copy(
        update={
            "name": f"{base.name}-relative-{seed}", "joints": tuple(joints), "nominal": nominal,
            "supply": supply, "sensors": sensors,
        }
    )  # fmt: skip


def _factor(rng: np.random.Generator, spread: float) -> float:
    return float(np.exp(np.clip(rng.normal(0.0, spread), -2 * spread, 2 * spread)))


def _joint(joint: Joint, area: float, pressure: float, rng: np.random.Generator) -> Joint:
    old = joint.cylinder
    cylinder = old.model_copy(
        update={
            "cap_area": old.cap_area * area, "rod_area": old.rod_area * area,
            "cap_pipe_volume": old.cap_pipe_volume * _factor(rng, 2 * SPREAD),
            "rod_pipe_volume": old.rod_pipe_volume * _factor(rng, 2 * SPREAD),
        }
    )  # fmt: skip
    limits = joint.limits.model_copy(update={"pressure": (-0.2e6, 1.3 * pressure)})
    return joint.model_copy(update={"cylinder": cylinder, "limits": limits})


def _scaled(name: str, mass: float, oil: float, areas: Sequence[float], supply: float) -> float:
    """Return a parameter's factor: links by mass, friction with them, gains for a like speed."""
    if name == "b":
        return oil
    if name.startswith("C_"):
        return float(areas[int(name[-1]) - 1] / np.sqrt(supply))
    return mass


def scenario_of(rig: Rig, seed: int, noise: float) -> Scenario:
    """Return what a machine hides, with its true parameters."""
    rng = np.random.default_rng([seed, STREAM + 1])
    drawn = draw(rig, seed)
    links = _factor(rng, UNKNOWN)  # together: the mass matrix stays positive definite
    truth = {
        name: value * (links if name[0] in "MRW" else _factor(rng, UNKNOWN))
        for name, value in rig.nominal.items()
    }
    return drawn.model_copy(update={"parameters": truth, "noise": noise})


def case_of(seed: int, noise: float) -> Case:
    """Return the case of a seed: its machine, what that hides, and what the right answer is."""
    rig = machine(seed)
    scenario = scenario_of(rig, seed, noise)
    label = f"{rig.name}: " + (" + ".join(f"{e.name} at {e.place}" for e in scenario.effects))
    if scenario.description.endswith(NO_FORMULA):
        moves = MOVES[scenario.effects[0].name]
        return Case(OUTSIDE, label, "", (), seed, (), moves, noise, machine=True)
    told = [e for e in scenario.effects if e.name not in ABSORBED]
    truth = tuple((e.name, place_of(_place(e))) for e in told)
    kind = (NONE, SINGLE, PAIR)[len(told)]
    return Case(kind, label, "", truth, seed, tuple(map(_size, told)), "", noise, machine=True)


def cases_of(count: int, seed: int) -> list[Case]:
    """Return the cases of `count` machines, seeds on from `seed`, noise in turn."""
    return [case_of(seed + k, NOISE[k % len(NOISE)]) for k in range(count)]


def _place(effect: Any) -> str:
    return f"channel {effect.channel}" if hasattr(effect, "channel") else str(effect.place)


def _size(effect: Any) -> float:
    """Return the size [SI] that was drawn."""
    return float(getattr(effect, next(iter(effect.sizes))))


def protocols_of(rig: Rig) -> tuple[Protocol, Protocol]:
    """Return the protocols made for a rig: to identify it, and to judge what was identified.

    Raises InputError where nothing can be planned for it.
    """
    from protocols.design.generate import generate, validation
    from rig.cli.proof.step_planning import predictor

    tools = predictor()
    plan = generate(rig, tools, f"lock-and-excite-{rig.name}").protocol
    return plan, validation(rig, tools.twin, f"validate-{rig.name}")
