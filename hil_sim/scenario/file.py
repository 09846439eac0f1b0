"""Scenario files: effects and faults of a simulated bench, unknown to the analysis.

    effects:
      - {name: coulomb_friction, where: joint 2, force: 80 N}
      - {name: channel_delay, channel: piston_1, time: 2 ms}
    parameters: {b: 200 MPa}     # in place of those of the machine's file
    faults:                      # what breaks while the bench runs, by the device's time
      - {name: sensor_stuck, channel: cap_pressure_1, at: 12 s}
      - {name: frame_lost, probability: 0.01, at: 5 s, until: 20 s}
    noise: 0.5                   # of what the rig's sensors state

`Scenario()` is a bench without effects and faults. Names are those of CONTRACT, "Effects"; their
forms here are the simulator's own (LuGre, rounded edges, lagging supply), finer than a regressor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator

from hil_sim.effects import AnyEffect
from hil_sim.effects.base import with_units
from hil_sim.faults import AnyFault
from hil_sim.faults.device import DeviceFault
from hil_sim.faults.wire import WireFault
from rig.model.parameters import parameter_unit
from rig.model.parse import InputError, parse_model, shipped_files
from rig.model.parts import Part
from rig.model.quantity import Ratio
from rig.model.rig import Rig


class Scenario(Part):
    """Effects, parameter overrides [SI] and a noise scale; the default changes nothing."""

    description: str = ""
    effects: tuple[AnyEffect, ...] = ()
    faults: tuple[AnyFault, ...] = ()
    parameters: Mapping[str, float] = {}
    noise: Annotated[Ratio, Field(ge=0, description="of the sensors' stated noise")] = 1.0

    @property
    def wire_faults(self) -> tuple[WireFault, ...]:
        """The faults of frames between host and device."""
        return tuple(fault for fault in self.faults if isinstance(fault, WireFault))

    @property
    def device_faults(self) -> tuple[DeviceFault, ...]:
        """The faults of the device's electronics."""
        return tuple(fault for fault in self.faults if isinstance(fault, DeviceFault))

    @field_validator("parameters", mode="before")
    @classmethod
    def _units(cls, value: Any, info: ValidationInfo) -> Any:
        return with_units(value, info, _unit_of)

    @field_validator("effects")
    @classmethod
    def _each_once(cls, value: tuple[AnyEffect, ...]) -> tuple[AnyEffect, ...]:
        places = set()
        for effect in value:
            if (effect.name, effect.place) in places:
                raise ValueError(f"{effect.name} at {effect.place} occurs twice")
            places.add((effect.name, effect.place))
        return value


def _unit_of(name: str) -> str:
    if name != "b" and not name.startswith(("C_", "Fv", "M", "R", "W")):
        raise ValueError(f"{name!r} is no parameter; expected one like M1 R12 Fv1 W1 b C_pp_1")
    return parameter_unit(name)


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the shipped scenarios."""
    return tuple(shipped_files("hil_sim", "scenarios"))


def load_shipped(name: str) -> Scenario:
    """Return a shipped scenario."""
    text = shipped_files("hil_sim", "scenarios")[name].read_text(encoding="utf-8")
    return parse_scenario(text, f"{name}.yaml")


def parse_scenario(text: str, source: str) -> Scenario:
    """Read scenario YAML; raises InputError naming `source`, line, key and what was expected."""
    return parse_model(Scenario, text, source)


def check_fits(scenario: Scenario, rig: Rig) -> None:
    """Raise InputError where an effect or fault is at a joint or channel that the rig lacks."""
    members: tuple[AnyEffect | AnyFault, ...] = (*scenario.effects, *scenario.faults)
    for member in members:
        joint = getattr(member, "joint", None)
        if joint is not None and joint >= len(rig.joints):
            raise InputError(
                f"scenario: {member.name} at {member.place}, but rig {rig.name!r} has "
                f"{len(rig.joints)} joint(s)"
            )
        for key in ("channel", "other"):
            channel = getattr(member, key, None)
            if channel is not None and channel not in rig.channels:
                raise InputError(
                    f"scenario: {member.name} at channel {channel!r}, but rig {rig.name!r} "
                    f"measures: {' '.join(rig.channels)}"
                )
