"""The effects a scenario may hold, as data: one class each, quantities in SI.

`where` is ``joint I``, ``bench`` or ``joint I cap|rod``; effects of measurement name a channel.
What each does to the plant stands in `plant_effects`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from hil_sim.scenario.effect_base import Effect
from hil_sim.scenario.truth import in_unit, read_with_unit
from rig.model.channels import kind_of, unit_of
from rig.model.quantity import Angle, Flow, Length, Pressure, Ratio, Speed, Time, Voltage, Volume

Force = Annotated[float, in_unit("N")]
Torque = Annotated[float, in_unit("N*m")]
Mass = Annotated[float, in_unit("kg")]
SpringRate = Annotated[float, in_unit("N*m/rad")]
ForcePerPressure = Annotated[float, in_unit("N/Pa")]
Conductance = Annotated[float, in_unit("m^3/(s*Pa)")]
PerLength = Annotated[float, in_unit("m^-1")]


class _Friction(Effect):
    where: str
    presliding: Length = Field(default=40e-6, gt=0, description="bristle deflection at slip [m]")


class CoulombFriction(_Friction):
    """Dry friction of the cylinder's seals; in a tapered bore it grows along the stroke."""

    name: Literal["coulomb_friction"]
    force: Force = Field(gt=0)
    taper: PerLength = Field(default=0.0, description="growth from mid-stroke [1/m]")


class StribeckFriction(_Friction):
    """Breakaway force above Coulomb's that falls off over `speed`."""

    name: Literal["stribeck_friction"]
    force: Force = Field(gt=0)
    speed: Speed = Field(gt=0)


class AsymmetricFriction(_Friction):
    """Dry friction that differs with direction."""

    name: Literal["asymmetric_friction"]
    extending: Force = Field(ge=0)
    retracting: Force = Field(ge=0)

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.extending == self.retracting == 0:
            raise ValueError("extending and retracting are both zero; give one of them")
        return self


class PressureDependentFriction(_Friction):
    """Dry friction that grows with what the seals hold: coefficient (p_cap + p_rod)."""

    name: Literal["pressure_dependent_friction"]
    coefficient: ForcePerPressure = Field(gt=0)


class BaseInclination(Effect):
    """The base tilts about the joints' axis; positive adds to the first angle."""

    places = ("bench",)
    name: Literal["base_inclination"]
    where: str = "bench"
    angle: Angle


class Payload(Effect):
    """A mass at the tip of the last link."""

    places = ("bench",)
    name: Literal["payload"]
    where: str = "bench"
    mass: Mass = Field(gt=0)


class JointSpring(Effect):
    """A hose that pulls the joint back to `rest` (default: mid-stroke), hardening [1/rad^2]."""

    name: Literal["joint_spring"]
    where: str
    stiffness: SpringRate = Field(gt=0)
    rest: Angle | None = None
    hardening: Annotated[float, in_unit("rad^-2")] = Field(default=0.25, ge=0)


class TorqueOffset(Effect):
    """A constant torque, positive opening."""

    name: Literal["torque_offset"]
    where: str
    torque: Torque


class ValveDeadband(Effect):
    """Overlapped edges: `width` either way (`astern`: the other way, if it differs), rounded."""

    name: Literal["valve_deadband"]
    where: str
    width: Voltage = Field(gt=0, description="of the spool's LVDT [V]")
    astern: Voltage | None = Field(default=None, gt=0)
    rounding: Voltage | None = Field(default=None, gt=0, description="default: a fifth of width")


class UnderlapLeakage(Effect):
    """Underlapped edges: near the null both pass oil, from pump to tank as well."""

    name: Literal["underlap_leakage"]
    where: str
    width: Voltage = Field(gt=0)
    rounding: Voltage | None = Field(default=None, gt=0, description="default: half of width")


class SpoolOffset(Effect):
    """The edges' null lies at this LVDT voltage."""

    name: Literal["spool_offset"]
    where: str
    voltage: Voltage


class SpoolLag(Effect):
    """The metered opening follows the LVDT with this time constant."""

    name: Literal["spool_lag"]
    where: str
    time: Time = Field(ge=2e-4)


class InternalLeakage(Effect):
    """Past the piston, cap to rod; in a bore worn about its middle, only there."""

    name: Literal["internal_leakage"]
    where: str
    conductance: Conductance = Field(gt=0)
    worn: Length | None = Field(default=None, gt=0, description="half length of the wear [m]")


class ExternalLeakage(Effect):
    """From one chamber, or both, to tank."""

    places = ("joint", "chamber")
    name: Literal["external_leakage"]
    where: str
    conductance: Conductance = Field(gt=0)


class SupplySag(Effect):
    """A worse supply: less pump flow, a softer relief valve, a line that drops pressure."""

    places = ("bench",)
    name: Literal["supply_sag"]
    where: str = "bench"
    flow: Flow | None = Field(default=None, gt=0, description="what the pump still gives")
    override: Pressure | None = Field(default=None, gt=0, description="relief, cracking to full")
    line_drop: Pressure | None = Field(
        default=None, gt=0, description="between pump and valves at the rig's pump flow"
    )
    manifold_volume: Volume = Field(default=0.2e-3, gt=0)

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.flow is None and self.override is None and self.line_drop is None:
            raise ValueError("give at least one of flow, override, line_drop")
        return self


class TankPressure(Effect):
    """Return pressure: a constant part and one that follows the returned flow's square."""

    places = ("bench",)
    name: Literal["tank_pressure"]
    where: str = "bench"
    pressure: Pressure = Field(ge=0)
    back_pressure: Pressure = Field(default=0.0, ge=0, description="more at the rig's pump flow")
    lag: Time = Field(default=5e-3, ge=5e-4)


class EntrainedAir(Effect):
    """Free air by volume at atmospheric pressure; it dissolves over `dissolution`."""

    places = ("bench",)
    name: Literal["entrained_air"]
    where: str = "bench"
    fraction: Ratio = Field(gt=0, lt=0.2)
    dissolution: Pressure = Field(default=10e6, gt=0)


class DeadVolume(Effect):
    """Oil between valve and chamber that the rig file does not know."""

    places = ("chamber",)
    name: Literal["dead_volume"]
    where: str
    volume: Volume = Field(gt=0)


class _Sensor(Effect):
    channel: str

    @field_validator("channel")
    @classmethod
    def _measured(cls, value: str) -> str:
        if kind_of(value)[0] == "command":
            raise ValueError(f"{value!r} is put out, not measured; expected one like piston_1")
        return value


class ChannelDelay(_Sensor):
    """The channel lags the world by this much more."""

    name: Literal["channel_delay"]
    time: Time = Field(gt=0, le=0.2)


class SensorGain(_Sensor):
    """The channel reads the true value times `gain`."""

    name: Literal["sensor_gain"]
    gain: Ratio = Field(gt=0)


class SensorOffset(_Sensor):
    """The channel reads `offset` too much, in its own unit."""

    name: Literal["sensor_offset"]
    offset: float

    @model_validator(mode="before")
    @classmethod
    def _unit_of_channel(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict) or not info.context or not {"channel", "offset"} <= {*data}:
            return data
        unit = unit_of(str(data["channel"]))
        unit = "delta_degC" if unit == "degC" else unit
        return {**data, "offset": read_with_unit(data["offset"], unit)}


AnyEffect = Annotated[
    CoulombFriction
    | StribeckFriction
    | AsymmetricFriction
    | PressureDependentFriction
    | BaseInclination
    | Payload
    | JointSpring
    | TorqueOffset
    | ValveDeadband
    | UnderlapLeakage
    | SpoolOffset
    | SpoolLag
    | InternalLeakage
    | ExternalLeakage
    | SupplySag
    | TankPressure
    | EntrainedAir
    | DeadVolume
    | ChannelDelay
    | SensorGain
    | SensorOffset,
    Field(discriminator="name"),
]
