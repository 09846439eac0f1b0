"""The rig description: frozen models that hold data in SI and refuse what cannot be built.

Source of the geometry and constants: NOTES of the method, "Linkage" and "Bench constants".
"""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)

from rig.model import channels as ch
from rig.model import linkage
from rig.model.parameters import MAX_JOINTS, parameter_names, parameter_unit
from rig.model.quantity import (
    Acceleration,
    Angle,
    Area,
    Density,
    Flow,
    Frequency,
    Length,
    Pressure,
    PressureRate,
    Speed,
    Temperature,
    TemperatureDifference,
    Time,
    Voltage,
    Volume,
    parse_quantity,
)

Array = linkage.Array


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Linkage(_Part):
    """Two pins and a cylinder: (lc + s)^2 = a^2 + c^2 - 2 a c cos(q + offset)."""

    base_pin: Length = Field(gt=0, description="a: joint to the pin on the inner link [m]")
    arm_pin: Length = Field(gt=0, description="c: joint to the pin on the outer link [m]")
    mid_length: Length = Field(gt=0, description="lc: pin to pin at mid-stroke [m]")
    offset: Angle = Field(default=0.0, description="beta - q [rad]")

    def angle(self, piston: Array | float) -> Array:
        """Return the joint angle q [rad] of piston displacement s [m]."""
        return linkage.angle_from_piston(
            piston, self.base_pin, self.arm_pin, self.mid_length, self.offset
        )

    def piston(self, q: Array | float) -> Array:
        """Return the piston displacement s [m] of joint angle q [rad]."""
        return linkage.piston_from_angle(
            q, self.base_pin, self.arm_pin, self.mid_length, self.offset
        )

    def jacobian(self, q: Array | float) -> Array:
        """Return G = ds/dq [m]."""
        return linkage.jacobian(q, self.base_pin, self.arm_pin, self.mid_length, self.offset)

    def jacobian_rate(self, q: Array | float) -> Array:
        """Return dG/dq [m/rad]."""
        return linkage.jacobian_rate(q, self.base_pin, self.arm_pin, self.mid_length, self.offset)


class Cylinder(_Part):
    """An asymmetric cylinder with the volumes of its two lines."""

    stroke: Length = Field(gt=0, description="L: full stroke, s runs from -L/2 to +L/2 [m]")
    cap_area: Area = Field(gt=0)
    rod_area: Area = Field(gt=0)
    cap_pipe_volume: Volume = Field(gt=0, description="V0 of the cap side [m^3]")
    rod_pipe_volume: Volume = Field(gt=0, description="V0 of the rod side [m^3]")

    @model_validator(mode="after")
    def _rod_is_smaller(self) -> Self:
        if self.rod_area > self.cap_area:
            raise ValueError(
                f"rod_area {self.rod_area:g} m^2 exceeds cap_area {self.cap_area:g} m^2; "
                "the rod side cannot be the larger one (swapped?)"
            )
        return self


class Valve(_Part):
    """A proportional valve: the command the device puts out and the spool it moves."""

    command_range: Voltage = Field(gt=0, description="outputs run from -range to +range [V]")
    command_bits: int = Field(ge=8, le=16)
    spool_gain: float = Field(gt=0, description="spool LVDT volts per command volt [V/V]")
    spool_stroke: Voltage = Field(gt=0, description="spool travel either way, in LVDT volts [V]")
    natural_frequency: Frequency = Field(default=100.0, gt=0)
    damping_ratio: float = Field(default=0.8, gt=0)


class Limits(_Part):
    """What may not be passed during a run; crossing one zeroes the outputs and latches a trip."""

    piston: tuple[Length, Length] = Field(description="allowed piston positions, excited [m]")
    speed: Speed = Field(gt=0, description="piston speed either way [m/s]")
    pressure: tuple[Pressure, Pressure] = Field(description="allowed chamber pressure [Pa gauge]")
    pressure_rate: PressureRate = Field(gt=0)
    command: Voltage = Field(gt=0, description="largest command either way [V]")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("piston", "pressure"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"limits {name}: lower {low:g} is not below upper {high:g}")
        return self


class Joint(_Part):
    """One hydraulic joint: link, linkage, cylinder, valve and its limits."""

    type: Literal["hydraulic"] = "hydraulic"
    name: str = Field(min_length=1)
    link_length: Length = Field(gt=0)
    linkage: Linkage
    cylinder: Cylinder
    valve: Valve
    limits: Limits

    @model_validator(mode="after")
    def _triangle_closes(self) -> Self:
        a, c = self.linkage.base_pin, self.linkage.arm_pin
        half = self.cylinder.stroke / 2
        for end, length in (
            ("retracted", self.linkage.mid_length - half),
            ("extended", self.linkage.mid_length + half),
        ):
            if not abs(a - c) < length < a + c:
                raise ValueError(
                    f"joint {self.name!r}: with the cylinder {end} its length is {length:.4g} m, "
                    f"but pins at {a:g} and {c:g} m close a triangle only between "
                    f"{abs(a - c):.4g} and {a + c:.4g} m; check base_pin, arm_pin, mid_length "
                    "(at MID-stroke) and stroke"
                )
        low, high = self.limits.piston
        if low < -half or high > half:
            raise ValueError(
                f"joint {self.name!r}: limits piston {low:g}..{high:g} m reach past the stroke "
                f"-{half:g}..{half:g} m"
            )
        if self.limits.command > self.valve.command_range:
            raise ValueError(
                f"joint {self.name!r}: limits command {self.limits.command:g} V is above the "
                f"valve's command_range {self.valve.command_range:g} V"
            )
        return self


class _Sensor(_Part):
    bits: int = Field(ge=8, le=16)
    delay: Time = Field(default=0.0, ge=0, description="the channel lags the world by this [s]")


class SpoolSensor(_Sensor):
    """The spool's LVDT."""

    range: tuple[Voltage, Voltage]
    noise: Voltage = Field(ge=0, description="one standard deviation [V]")


class PistonSensor(_Sensor):
    """The piston's position sensor."""

    range: tuple[Length, Length]
    noise: Length = Field(ge=0)


class PressureSensor(_Sensor):
    """A pressure sensor."""

    range: tuple[Pressure, Pressure]
    noise: Pressure = Field(ge=0)


class TemperatureSensor(_Sensor):
    """The oil's thermometer."""

    range: tuple[Temperature, Temperature]
    noise: TemperatureDifference = Field(ge=0)


AnySensor = SpoolSensor | PistonSensor | PressureSensor | TemperatureSensor


class Sensors(_Part):
    """One description per kind of channel; those of the bench are optional."""

    spool: SpoolSensor
    piston: PistonSensor
    chamber_pressure: PressureSensor
    supply_pressure: PressureSensor | None = None
    oil_temperature: TemperatureSensor | None = None
    skew: Time = Field(default=0.0, ge=0, description="between neighbours in the multiplexer [s]")

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name in type(self).model_fields:
            sensor = getattr(self, name)
            if isinstance(sensor, _Sensor):
                low, high = sensor.range  # type: ignore[attr-defined]
                if not low < high:
                    raise ValueError(f"sensors {name}: range {low:g}..{high:g} is empty")
        return self

    def of(self, kind: str) -> AnySensor:
        """Return the sensor of a channel kind; raises KeyError where the rig has none."""
        found = {
            ch.SPOOL: self.spool,
            ch.PISTON: self.piston,
            ch.CAP: self.chamber_pressure,
            ch.ROD: self.chamber_pressure,
            ch.SUPPLY: self.supply_pressure,
            ch.TEMPERATURE: self.oil_temperature,
        }[kind]
        if found is None:
            raise KeyError(f"this rig has no sensor for {kind!r}")
        return found


class Supply(_Part):
    """The pump: set pressure and flow limit."""

    pressure: Pressure = Field(gt=0)
    flow: Flow = Field(gt=0)


class Oil(_Part):
    """The working fluid."""

    name: str
    density: Density = Field(gt=0)
    temperature: Temperature
    temperature_band: TemperatureDifference = Field(default=2.0, ge=0)


class Wire(_Part):
    """How the bench is reached."""

    kind: Literal["modbus-tcp"] = "modbus-tcp"
    host: str = "127.0.0.1"
    port: int = Field(default=5020, ge=0, le=65535)
    timeout: Time = Field(default=1.0, gt=0, description="answer expected within [s]")
    watchdog: Time = Field(default=0.5, gt=0, description="host silence after which outputs zero")


class Rig(_Part):
    """A whole test bench."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")
    description: str = ""
    gravity: Acceleration = Field(default=9.8, gt=0)
    sample_rate: Frequency = Field(gt=0)
    supply: Supply
    oil: Oil
    joints: tuple[Joint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    sensors: Sensors
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
        """Hand a description of electric joints to `rig.model.electric.ElectricRig`."""
        types = _types(data) if cls is Rig else set()
        if "electric" not in types:
            return handler(data)
        if types != {"electric"}:
            raise ValueError("joints of both types, hydraulic and electric, in one rig: not yet")
        from rig.model.electric import ElectricRig  # noqa: PLC0415 - it is a Rig itself

        return ElectricRig.model_validate(data, context=info.context)

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_units(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, dict) or "joints" not in info.data:
            return value
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
        return {k: parse_quantity(str(v), parameter_unit(k)) for k, v in value.items()}

    @property
    def electric(self) -> bool:
        """Whether the joints are electric (`rig.model.electric`)."""
        return False

    @property
    def position_kind(self) -> str:
        """Channel kind of a joint's position."""
        return ch.PISTON

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Channel kinds that an excited joint needs."""
        return ch.JOINT_KINDS

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
        """The measured channels, in the order every block and file keeps."""
        return ch.measured(
            len(self.joints),
            supply=self.sensors.supply_pressure is not None,
            temperature=self.sensors.oil_temperature is not None,
        )

    @property
    def recorded(self) -> tuple[str, ...]:
        """The measured channels, then the commands put out."""
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


def _types(data: Any) -> set[str]:
    """Return the types of the joints of a raw description, as far as it is one."""
    joints = data.get("joints") if isinstance(data, dict) else None
    if not isinstance(joints, list | tuple):
        return set()
    return {str(j.get("type", "hydraulic")) for j in joints if isinstance(j, dict)}
