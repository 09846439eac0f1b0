"""Electric joints: a drive gain where a hydraulic joint has cylinder, valve and linkage.

An `ElectricRig` is a `Rig` for everything that asks for joints, channels, sensors or mechanics;
what it has not (supply, oil, cylinders) says so when asked for. All joints of a rig are of one
type. A rig file chooses by `type: electric` at its joints; `Rig.model_validate` returns this class.
"""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from rig.model import channels as ch
from rig.model.parameters import inertia_names, parameter_unit
from rig.model.parse import InputError
from rig.model.parts import Array, Oil, Part, Supply
from rig.model.quantity import (
    Acceleration,
    Angle,
    Length,
    Time,
    UnitError,
    parse_quantity,
)
from rig.model.rig import Rig

UNKNOWN = "unknown"
INCLINATION = "base_inclination"
_NOT_HERE = ("linkage", "cylinder", "valve")
_FORCE = {"revolute": "N*m", "prismatic": "N"}
_PLACE = {"revolute": "rad", "prismatic": "m"}


def _si(value: Any, si: str, info: ValidationInfo) -> Any:
    """Read a quantity whose unit another key decides; a number alone only outside files."""
    if isinstance(value, str):
        return parse_quantity(value, si)
    if info.context and isinstance(value, int | float):
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '1 {si}'")
    return value


def _pair(value: Any, si: str, info: ValidationInfo) -> Any:
    return [_si(v, si, info) for v in value] if isinstance(value, list | tuple) else value


class Drive(Part):
    """What turns the drive's signal into a torque or force: `gain` times the signal."""

    unit: Literal["V", "A", "N", "N*m"]
    gain: float = Field(description="force or torque per unit of drive [N/unit or N*m/unit]")


class ElectricLimits(Part):
    """What may not be passed during a run."""

    position: tuple[float, float] = Field(description="allowed positions [rad or m]")
    speed: float = Field(gt=0, description="either way [rad/s or m/s]")
    drive: float = Field(gt=0, description="largest drive either way, in the drive's unit")


class ElectricJoint(Part):
    """One electric joint: revolute about, or prismatic along, its axis."""

    type: Literal["electric"]
    name: str = Field(min_length=1)
    kind: Literal["revolute", "prismatic"]
    link_length: Length | None = Field(default=None, gt=0)
    drive: Drive
    limits: ElectricLimits

    @field_validator("drive", mode="before")
    @classmethod
    def _gain_unit(cls, value: Any, info: ValidationInfo) -> Any:
        kind = info.data.get("kind")
        if not isinstance(value, dict) or kind is None or "gain" not in value:
            return value
        unit = str(value.get("unit", "V"))
        force = _FORCE[kind]
        si = f"{force}/({unit})" if unit != force else ""
        return {**value, "gain": _si(value["gain"], si, info) if si else value["gain"]}

    @field_validator("limits", mode="before")
    @classmethod
    def _limit_units(cls, value: Any, info: ValidationInfo) -> Any:
        kind, drive = info.data.get("kind"), info.data.get("drive")
        if not isinstance(value, dict) or kind is None or drive is None:
            return value
        place = _PLACE[kind]
        out = dict(value)
        if "position" in out:
            out["position"] = _pair(out["position"], place, info)
        for key, si in (("speed", f"{place}/s"), ("drive", drive.unit)):
            if key in out:
                out[key] = _si(out[key], si, info)
        return out

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        low, high = self.limits.position
        if not low < high:
            raise ValueError(f"limits position: lower {low:g} is not below upper {high:g}")
        if self.drive.gain == 0.0:
            raise ValueError("drive gain 0 moves nothing")
        return self

    @property
    def force_unit(self) -> str:
        """Unit of what the drive exerts: N*m or N."""
        return _FORCE[self.kind]

    @property
    def position_unit(self) -> str:
        """Unit of the position: rad or m."""
        return _PLACE[self.kind]

    def __getattr__(self, name: str) -> Any:
        """Refuse what only a hydraulic joint has, in words; raises InputError."""
        if name in _NOT_HERE:
            raise InputError(
                f"joint {self.name!r} is electric and has no {name}; this works on hydraulic "
                "rigs only"
            )
        return super().__getattr__(name)  # type: ignore[misc]


class ElectricSensor(Part):
    """A position encoder or a drive's read-back; ranges in the joint's and the drive's unit."""

    range: tuple[float, float]
    bits: int = Field(ge=8, le=32)
    noise: float = Field(ge=0, description="one standard deviation")
    delay: Time = Field(default=0.0, ge=0, description="the channel lags the world by this [s]")

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.range[0] < self.range[1]:
            raise ValueError(f"range {self.range[0]:g}..{self.range[1]:g} is empty")
        return self


class ElectricSensors(Part):
    """One description per kind of channel."""

    position: ElectricSensor
    drive: ElectricSensor
    skew: Time = Field(default=0.0, ge=0, description="between neighbours in the multiplexer [s]")

    def of(self, kind: str) -> ElectricSensor:
        """Return the sensor of a channel kind; raises KeyError where the rig has none."""
        return {ch.POSITION: self.position, ch.DRIVE: self.drive}[kind]


class ElectricRig(Rig):
    """A robot of electric joints: a planar chain of revolute ones, or one prismatic joint.

    `gravity` 0 means motion in a horizontal plane. `inclination` turns the base about the joints'
    axis [rad], or is `unknown`: then it is identified, common to all joints (the paper's last
    claim).
    """

    # A Rig to whoever asks for mechanics; the narrower types are this module's whole purpose.
    gravity: Acceleration = Field(default=9.8, ge=0)
    inclination: Angle | Literal["unknown"] = 0.0
    supply: Supply | None = Field(default=None, exclude=True)  # type: ignore[assignment]
    oil: Oil | None = Field(default=None, exclude=True)  # type: ignore[assignment]
    joints: tuple[ElectricJoint, ...] = Field(min_length=1, max_length=9)  # type: ignore[assignment]
    sensors: ElectricSensors  # type: ignore[assignment]

    @field_validator("supply", "oil", mode="before")
    @classmethod
    def _no_fluid(cls, value: Any) -> Any:
        if value is not None:
            raise ValueError("an electric rig has neither supply nor oil; remove this key")
        return value

    @field_validator("sensors", mode="before")
    @classmethod
    def _sensor_units(cls, value: Any, info: ValidationInfo) -> Any:
        joints = info.data.get("joints")
        if not isinstance(value, dict) or not joints:
            return value
        units = {"position": joints[0].position_unit, "drive": joints[0].drive.unit}
        out = dict(value)
        for key, si in units.items():
            if isinstance(out.get(key), dict):
                sensor = dict(out[key])
                if "range" in sensor:
                    sensor["range"] = _pair(sensor["range"], si, info)
                if "noise" in sensor:
                    sensor["noise"] = _si(sensor["noise"], si, info)
                out[key] = sensor
        return out

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_units(cls, value: object, info: ValidationInfo) -> object:
        joints = info.data.get("joints")
        if not isinstance(value, dict) or not joints:
            return value
        known = {name: _unit(name, joints) for name in _nominal_names(joints)}
        for name in value:
            if name not in known:
                raise ValueError(
                    f"{name!r} is no parameter of an electric rig with {len(joints)} joint(s); "
                    f"expected one of: {' '.join(known)}"
                )
        return {k: _si(v, known[k], info) for k, v in value.items()}

    @model_validator(mode="after")
    def _one_machine(self) -> Self:
        kinds = {joint.kind for joint in self.joints}
        if "prismatic" in kinds and len(self.joints) > 1:
            raise ValueError(
                "a prismatic joint is supported alone; joints of a chain are all revolute"
            )
        if len({joint.drive.unit for joint in self.joints}) > 1:
            raise ValueError("all joints of a rig share one drive unit, as they share one sensor")
        if self.inclination == UNKNOWN and (self.prismatic or self.gravity == 0.0):
            raise ValueError(
                "inclination: unknown needs revolute joints and gravity; for a prismatic joint the "
                "slope's pull is a torque_offset"
            )
        return self

    @property
    def electric(self) -> bool:
        """Whether the joints are electric."""
        return True

    @property
    def prismatic(self) -> bool:
        """Whether the rig is one prismatic joint."""
        return self.joints[0].kind == "prismatic"

    @property
    def position_kind(self) -> str:
        """Channel kind of a joint's position."""
        return ch.POSITION

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Channel kinds of an excited joint."""
        return ch.ELECTRIC_KINDS

    @property
    def channels(self) -> tuple[str, ...]:
        """The measured channels, in the order every block and file keeps."""
        each = range(1, len(self.joints) + 1)
        return tuple(ch.channel(kind, i) for i in each for kind in ch.ELECTRIC_KINDS)

    @property
    def recorded(self) -> tuple[str, ...]:
        """The channels of a record: the drive is measured, there is no command beside it."""
        return self.channels

    @property
    def base_angle(self) -> float:
        """Known inclination of the base [rad]; 0 where it is unknown."""
        return 0.0 if self.inclination == UNKNOWN else float(self.inclination)

    def unit_of(self, channel: str) -> str:
        """Return the unit of a channel's samples."""
        kind, joint = ch.kind_of(channel)
        place = self.joints[(joint or 1) - 1]
        return {ch.POSITION: place.position_unit, ch.DRIVE: place.drive.unit}[kind]

    def unit_of_parameter(self, name: str) -> str:
        """Return the SI unit of a parameter; a prismatic joint has kg and N s/m."""
        return _unit(name, self.joints)

    def chamber_volumes(self, joint: int, piston: Array) -> tuple[Array, Array]:
        """Return zeros: there are no chambers."""
        return np.zeros_like(piston), np.zeros_like(piston)


def _nominal_names(joints: tuple[ElectricJoint, ...]) -> tuple[str, ...]:
    each = range(1, len(joints) + 1)
    weights = () if joints[0].kind == "prismatic" else tuple(f"W{i}" for i in each)
    extra = tuple(f"{kind}{i}" for kind in ("Fc", "offset") for i in each)
    return (*inertia_names(len(joints)), *(f"Fv{i}" for i in each), *weights, *extra)


def _unit(name: str, joints: tuple[ElectricJoint, ...]) -> str:
    force = joints[0].force_unit
    if name == INCLINATION:
        return "rad"
    if name.startswith(("Fc", "offset")):
        return force
    if joints[0].kind == "revolute":
        return parameter_unit(name)
    return {"M1": "kg", "Fv1": "N*s/m"}.get(name, parameter_unit(name))


def drive_gains(rig: Rig) -> tuple[float, ...]:
    """Return each joint's drive gain; zeros for a hydraulic rig."""
    if isinstance(rig, ElectricRig):
        return tuple(joint.drive.gain for joint in rig.joints)
    return (0.0,) * len(rig.joints)


def position_limits(rig: Rig, joint: int) -> tuple[float, float]:
    """Return the allowed positions [rad or m] of joint `joint` (0-based) of an electric rig."""
    if not isinstance(rig, ElectricRig):
        raise TypeError(f"rig {rig.name!r} is not electric")
    return rig.joints[joint].limits.position
