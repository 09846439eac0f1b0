"""The rig description: a whole bench, its channels and its design values.

The parts of a bench are in `rig.model.parts`, those of electric joints in `rig.model.electric`. An
`ElectricRig` has the interface of a `Rig` for joints, channels, sensors and mechanics; a rig file
selects it by `type: electric` at its joints, and `Rig.model_validate` returns that class.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final, Literal, Self

import numpy as np
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)

from rig.model import channels as ch
from rig.model.alarms.bands import Alarms, Range, refuse_unreachable
from rig.model.electric import (
    UNKNOWN,
    ElectricJoint,
    ElectricSensors,
    electric_names,
    electric_unit,
    si_pair,
    si_value,
)
from rig.model.parameters import MAX_JOINTS, is_positive, parameter_names, parameter_unit
from rig.model.parts import Array, BenchLimits, Joint, Name, Oil, Part, Sensors, Supply, Wire
from rig.model.quantity import Acceleration, Angle, Frequency, parse_quantity
from rig.model.tolerances import (
    Tolerances,
    UncertainNumber,
    refuse_open_triangles,
    uncertain_numbers,
)

MAX_SAMPLE_RATE: Final = 100e3  # [Hz], far above hydraulics; the twin's memory grows with it
MAX_GRAVITY: Final = 30.0  # [m/s^2], above every planet with a surface: more is a wrong unit


class Rig(Part):
    """A whole test bench."""

    name: Name
    description: str = ""
    gravity: Acceleration = Field(default=9.8, ge=0, le=MAX_GRAVITY)
    sample_rate: Frequency = Field(gt=0, le=MAX_SAMPLE_RATE)
    supply: Supply
    oil: Oil
    joints: tuple[Joint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    sensors: Sensors
    tolerances: Tolerances | None = Field(default=None, exclude_if=lambda value: value is None)
    limits: BenchLimits = BenchLimits()
    alarms: Alarms = Alarms()
    wire: Wire = Wire()
    nominal: dict[str, float] = Field(
        default_factory=dict,
        description="design values by parameter name, for the twin and the report, not the fit",
    )

    @model_validator(mode="wrap")
    @classmethod
    def _by_type(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Any:
        """Read a description by the class of rig that its joints' `type` selects."""
        types = _types(data) & set(_CLASSES) if cls is Rig else set()
        if len(types) > 1:
            raise ValueError("joints of both types, hydraulic and electric, in one rig: not yet")
        chosen = _CLASSES[types.pop()] if types else cls
        return handler(data) if chosen is cls else chosen.model_validate(data, context=info.context)

    @field_validator("joints")
    @classmethod
    def _one_name_each(cls, value: tuple[Joint, ...]) -> tuple[Joint, ...]:
        """Reject a name that two joints share: messages and tables name joints by it."""
        names = [joint.name for joint in value]
        for at, name in enumerate(names):
            if name in names[:at]:
                raise ValueError(
                    f"joints {names.index(name) + 1} and {at + 1} are both named {name!r}; "
                    "give each a name of its own"
                )
        return value

    @field_validator("tolerances")
    @classmethod
    def _tolerances_fit(cls, value: Tolerances | None, info: ValidationInfo) -> Tolerances | None:
        refuse_open_triangles(value, info.data.get("joints", ()))
        return value

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_units(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, dict):
            return value
        if "joints" not in info.data:
            return {}  # the joints are invalid, and the list of parameters depends on them
        joints = len(info.data["joints"])
        known = parameter_names(joints)
        for name in value:
            if name not in known:
                raise ValueError(
                    f"{name!r} is no parameter of a rig with {joints} joint(s); "
                    f"expected one of: {' '.join(known)}"
                )
        if not info.context:
            return value
        values = {k: parse_quantity(str(v), parameter_unit(k)) for k, v in value.items()}
        for name, number in values.items():
            if number <= 0.0 and is_positive(name):
                raise ValueError(f"{name!r} is {value[name]}; expected greater than 0")
            if number < 0.0 and name.startswith("Fv"):
                raise ValueError(f"{name!r} is {value[name]}; expected 0 or more")
        return values

    @model_validator(mode="after")
    def _calibrations_of_channels(self) -> Self:
        stated = () if self.electric else self.sensors.calibrations
        unknown = [name for name in stated if name not in self.channels]
        if unknown:
            raise ValueError(
                f"sensors calibrations {unknown[0]}: this rig has no such channel; it has "
                f"{' '.join(self.channels)}"
            )
        return self

    @model_validator(mode="after")
    def _limits_can_be_seen(self) -> Self:
        """Reject a limit beyond the sensor's range, which no sample could pass."""
        if self.electric:
            if self.limits != BenchLimits():
                raise ValueError("an electric rig has neither supply nor oil; remove limits")
            if self.alarms != Alarms():
                raise ValueError("an electric rig is not run by a bench; remove alarms")
            return self
        top = self.sensors.chamber_pressure.range[1]
        for joint in self.joints:
            limit = joint.limits.pressure[1]
            if limit >= top:
                raise ValueError(
                    f"joint {joint.name!r}: limits pressure up to {limit / 1e6:g} MPa can never be "
                    f"exceeded by a reading: the range of sensors chamber_pressure ends at "
                    f"{top / 1e6:g} MPa; lower the limit or state the sensor's true range"
                )
        for name in BenchLimits.model_fields:
            limits, sensor = getattr(self.limits, name), getattr(self.sensors, name)
            if limits is None:
                continue
            if sensor is None:
                raise ValueError(f"limits {name}: this rig has no sensor {name}")
            if limits[1] >= sensor.range[1]:
                raise ValueError(
                    f"limits {name}: the upper one, {limits[1]:g}, can never be exceeded by a "
                    f"reading: the sensor's range ends at {sensor.range[1]:g}"
                )
        limits = {name: self.limits_of(name) for name in self.recorded}
        refuse_unreachable(self.alarms, self.recorded, self.range_of, limits)
        return self

    def range_of(self, channel: str) -> Range:
        """Return a channel's readable range: that of its sensor, or of the output."""
        kind, joint = ch.kind_of(channel)
        if kind == ch.COMMAND and joint is not None:
            reach = self.joints[joint - 1].valve.command_range
            return -reach, reach
        return self.sensors.of(kind).range

    def limits_of(self, channel: str) -> Range:
        """Return the limits of a channel in SI, excited or locked; infinite where none are set."""
        kind, joint = ch.kind_of(channel)
        everything = (-math.inf, math.inf)
        if joint is None:
            shared = self.limits
            limits = shared.supply_pressure if kind == ch.SUPPLY else shared.oil_temperature
            return limits or everything
        own = self.joints[joint - 1].limits
        limits_by_kind = {
            ch.CAP: own.pressure,
            ch.ROD: own.pressure,
            ch.PISTON: own.piston,
            ch.COMMAND: (-own.command, own.command),
        }
        return limits_by_kind.get(kind, everything)

    @property
    def uncertain_numbers(self) -> tuple[UncertainNumber, ...]:
        """The areas, volumes and lengths with `tolerances`; none without that section."""
        return uncertain_numbers(self.tolerances, self.joints)

    def with_moved(self, number: UncertainNumber) -> Self:
        """Return the rig with one of its numbers increased by its tolerance."""
        return self.model_copy(update={"joints": number.moved(self.joints)})

    def with_deviations(self, deviations: Iterable[float]) -> Self:
        """Return the rig with each of its uncertain numbers increased by so many sigma."""
        rig = self
        for number, deviation in zip(self.uncertain_numbers, deviations, strict=True):
            rig = rig.with_moved(replace(number, sigma=deviation * number.sigma))
        return rig

    @property
    def electric(self) -> bool:
        """Whether the joints are electric (`rig.model.electric`)."""
        return "fluid" not in self.families

    @property
    def position_kind(self) -> str:
        """Channel kind of a joint's position."""
        return self.joints[0].position_kind

    @property
    def drive_kind(self) -> str:
        """Channel kind of a joint's drive: spool or drive."""
        return self.joints[0].drive_kind

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Channel kinds that an excited joint needs."""
        return self.joints[0].kinds

    @property
    def simulated_kinds(self) -> tuple[str, ...]:
        """Channel kinds of a joint that a simulation predicts."""
        return self.joints[0].simulated_kinds

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the joints' equations: mechanical, and fluid for hydraulic joints."""
        return self.joints[0].families

    @property
    def drive_gains(self) -> tuple[float, ...]:
        """Each joint's force or torque per unit of drive; zeros for a hydraulic rig."""
        return tuple(joint.drive_gain for joint in self.joints)

    def largest_force(self, joint: int) -> float:
        """Return the largest force [N] of the cylinder of joint `joint` (0-based)."""
        return self.joints[joint].cylinder.cap_area * self.supply.pressure

    @property
    def base_angle(self) -> float:
        """Known inclination of the base [rad], added to every absolute angle."""
        return 0.0

    def unit_of(self, channel: str) -> str:
        """Return the unit of a channel's samples."""
        return ch.unit_of(channel)

    def unit_of_parameter(self, name: str) -> str:
        """Return the SI unit of a parameter."""
        return parameter_unit(name)

    @property
    def channels(self) -> tuple[str, ...]:
        """The measured channels, in the order of blocks and files."""
        return ch.measured(
            len(self.joints),
            supply=self.sensors.supply_pressure is not None,
            temperature=self.sensors.oil_temperature is not None,
        )

    @property
    def recorded(self) -> tuple[str, ...]:
        """The measured channels, then the commands."""
        return (*self.channels, *(ch.channel(ch.COMMAND, i + 1) for i in range(len(self.joints))))

    def chamber_volumes(self, joint: int, piston: Array) -> tuple[Array, Array]:
        """Return (V_cap, V_rod) [m^3] of joint `joint` (0-based) at piston displacement s [m]."""
        c = self.joints[joint].cylinder
        half = c.stroke / 2
        s = np.asarray(piston, dtype=np.float64)
        return (
            c.cap_pipe_volume + (half + s) * c.cap_area,
            c.rod_pipe_volume + (half - s) * c.rod_area,
        )


class ElectricRig(Rig):
    """A robot of electric joints: a planar chain of revolute ones, or one prismatic joint.

    `gravity` 0 means motion in a horizontal plane. `inclination` turns the base about the joints'
    axis [rad], or is `unknown`: then it is identified, common to all joints (the paper's last
    claim).
    """

    # The narrower types of these fields are the purpose of this class.
    gravity: Acceleration = Field(default=9.8, ge=0, le=MAX_GRAVITY)
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

    @field_validator("tolerances", mode="before")
    @classmethod
    def _no_tolerances(cls, value: Any) -> Any:
        if value is not None:
            raise ValueError("an electric rig has neither cylinders nor linkages; remove this key")
        return value

    @field_validator("sensors", mode="before")
    @classmethod
    def _sensor_units(cls, value: Any, info: ValidationInfo) -> Any:
        joints = info.data.get("joints")
        if not isinstance(value, dict):
            return value
        if not joints:
            raise ValueError("depends on the joints, which must be corrected first")
        units = {"position": joints[0].position_unit, "drive": joints[0].drive.unit}
        out = dict(value)
        for key, si in units.items():
            if isinstance(out.get(key), dict):
                sensor = dict(out[key])
                if "range" in sensor:
                    sensor["range"] = si_pair(sensor["range"], si, info)
                if "noise" in sensor:
                    sensor["noise"] = si_value(sensor["noise"], si, info)
                out[key] = sensor
        return out

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_units(cls, value: object, info: ValidationInfo) -> object:
        joints = info.data.get("joints")
        if not isinstance(value, dict):
            return value
        if not joints:
            return {}  # invalid, and the list of parameters depends on them
        known = {name: electric_unit(name, joints) for name in electric_names(joints)}
        for name in value:
            if name not in known:
                raise ValueError(
                    f"{name!r} is no parameter of an electric rig with {len(joints)} joint(s); "
                    f"expected one of: {' '.join(known)}"
                )
        return {k: si_value(v, known[k], info) for k, v in value.items()}

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
    def prismatic(self) -> bool:
        """Whether the rig is one prismatic joint."""
        return self.joints[0].kind == "prismatic"

    @property
    def channels(self) -> tuple[str, ...]:
        """The measured channels, in the order of blocks and files."""
        each = range(1, len(self.joints) + 1)
        return tuple(ch.channel(kind, i) for i in each for kind in ch.ELECTRIC_KINDS)

    @property
    def recorded(self) -> tuple[str, ...]:
        """The channels of a record: the measured ones, which include the drive."""
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
        return electric_unit(name, self.joints)

    def chamber_volumes(self, joint: int, piston: Array) -> tuple[Array, Array]:
        """Return zeros: there are no chambers."""
        return np.zeros_like(piston), np.zeros_like(piston)

    def largest_force(self, joint: int) -> float:
        """Return the largest force or torque [N or N m] of the drive of joint `joint` (0-based)."""
        return abs(self.joints[joint].drive.gain) * self.joints[joint].limits.drive


_CLASSES: dict[str, type[Rig]] = {"hydraulic": Rig, "electric": ElectricRig}


def _types(data: Any) -> set[str]:
    """Return the types of the joints of a raw description, as far as it is valid."""
    joints = data.get("joints") if isinstance(data, dict) else None
    if not isinstance(joints, list | tuple):
        return set()
    return {str(j.get("type", "hydraulic")) for j in joints if isinstance(j, dict)}
