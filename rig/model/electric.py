"""Electric joints: a drive gain where a hydraulic joint has cylinder, valve and linkage.

Access to parts of a hydraulic joint (linkage, cylinder, valve) raises InputError. All joints of a
rig are of one type; `rig.model.rig.ElectricRig` holds them.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from rig.model import channels as ch
from rig.model.parameters import inertia_names, parameter_unit
from rig.model.parse import InputError
from rig.model.parts import Array, Part
from rig.model.quantity import Length, Time, UnitError, parse_quantity

UNKNOWN = "unknown"
INCLINATION = "base_inclination"
_NOT_HERE = ("linkage", "cylinder", "valve")
_FORCE = {"revolute": "N*m", "prismatic": "N"}
_PLACE = {"revolute": "rad", "prismatic": "m"}


def si_value(value: Any, si: str, info: ValidationInfo) -> Any:
    """Read a quantity whose unit depends on another key; a bare number only outside files."""
    if isinstance(value, str):
        return parse_quantity(value, si)
    if info.context and isinstance(value, int | float):
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '1 {si}'")
    return value


def si_pair(value: Any, si: str, info: ValidationInfo) -> Any:
    """Read a pair of quantities (see `si_value`); anything else is left to later checks."""
    return [si_value(v, si, info) for v in value] if isinstance(value, list | tuple) else value


class Drive(Part):
    """The drive: force or torque is `gain` times its signal."""

    unit: Literal["V", "A", "N", "N*m"]
    gain: float = Field(description="force or torque per unit of drive [N/unit or N*m/unit]")


class ElectricLimits(Part):
    """Limits during a run."""

    position: tuple[float, float] = Field(description="allowed positions [rad or m]")
    speed: float = Field(gt=0, description="either way [rad/s or m/s]")
    drive: float = Field(gt=0, description="largest drive either way, in the drive's unit")


class ElectricJoint(Part):
    """One electric joint: revolute about, or prismatic along, its axis."""

    kinds: ClassVar[tuple[str, ...]] = ch.ELECTRIC_KINDS
    position_kind: ClassVar[str] = ch.POSITION
    drive_kind: ClassVar[str] = ch.DRIVE
    simulated_kinds: ClassVar[tuple[str, ...]] = (ch.POSITION,)
    families: ClassVar[tuple[str, ...]] = ("mechanical",)

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
        return {**value, "gain": si_value(value["gain"], si, info) if si else value["gain"]}

    @field_validator("limits", mode="before")
    @classmethod
    def _limit_units(cls, value: Any, info: ValidationInfo) -> Any:
        kind, drive = info.data.get("kind"), info.data.get("drive")
        if not isinstance(value, dict) or kind is None or drive is None:
            return value
        place = _PLACE[kind]
        out = dict(value)
        if "position" in out:
            out["position"] = si_pair(out["position"], place, info)
        for key, si in (("speed", f"{place}/s"), ("drive", drive.unit)):
            if key in out:
                out[key] = si_value(out[key], si, info)
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
        """Unit of the drive's torque or force: N*m or N."""
        return _FORCE[self.kind]

    @property
    def position_unit(self) -> str:
        """Unit of the position: rad or m."""
        return _PLACE[self.kind]

    @property
    def drive_gain(self) -> float:
        """Force or torque per unit of drive."""
        return self.drive.gain

    @property
    def position_range(self) -> tuple[float, float]:
        """The positions allowed [rad or m]."""
        return self.limits.position

    def geometry(self, position: Array | float) -> tuple[Array, Array, Array]:
        """Return q = position, G = 1 and dG/dq = 0: the drive acts at the joint itself."""
        q = np.asarray(position, dtype=np.float64)
        return q, np.ones_like(q), np.zeros_like(q)

    def __getattr__(self, name: str) -> Any:
        """Raise InputError for a part that only a hydraulic joint has."""
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
    delay: Time = Field(default=0.0, ge=0, description="delay of the channel [s]")

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


def electric_names(joints: tuple[ElectricJoint, ...]) -> tuple[str, ...]:
    """Return the names of the parameters of an electric rig that may have nominal values."""
    each = range(1, len(joints) + 1)
    weights = () if joints[0].kind == "prismatic" else tuple(f"W{i}" for i in each)
    extra = tuple(f"{kind}{i}" for kind in ("Fc", "offset") for i in each)
    return (*inertia_names(len(joints)), *(f"Fv{i}" for i in each), *weights, *extra)


def electric_unit(name: str, joints: tuple[ElectricJoint, ...]) -> str:
    """Return the SI unit of a parameter of an electric rig."""
    force = joints[0].force_unit
    if name == INCLINATION:
        return "rad"
    if name.startswith(("Fc", "offset")):
        return force
    if joints[0].kind == "revolute":
        return parameter_unit(name)
    return {"M1": "kg", "Fv1": "N*s/m"}.get(name, parameter_unit(name))
