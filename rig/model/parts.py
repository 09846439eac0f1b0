"""Parts of a bench: frozen models that hold data in SI and reject what cannot be built.

Source of the geometry and constants: Sakai and Maeshima, section II and Table II.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal, Self
from urllib.parse import urlencode

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from rig.model import channels as ch
from rig.model import linkage
from rig.model.quantity import (
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
    is_from_file,
)

Array = linkage.Array

WATCHDOG_RANGE: Final = (0.02, 10.0)  # [s] that a device can be set to (docs/wire-modbus-tcp.md)

MAX_NAME: Final = 80  # characters; a name becomes part of a file's name
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=MAX_NAME)]


class Part(BaseModel):
    """A part of a description: frozen, no unknown keys, finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Linkage(Part):
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

    def geometry(self, piston: Array | float) -> tuple[Array, Array, Array]:
        """Return q [rad], G = ds/dq [m] and dG/dq [m/rad] of piston displacement s [m]."""
        return linkage.geometry_from_piston(
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


class Cylinder(Part):
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


class Valve(Part):
    """A proportional valve: command range and spool dynamics."""

    command_range: Voltage = Field(gt=0, description="outputs run from -range to +range [V]")
    command_bits: int = Field(ge=8, le=16)
    spool_gain: float = Field(gt=0, description="spool LVDT volts per command volt [V/V]")
    spool_stroke: Voltage = Field(gt=0, description="spool travel either way, in LVDT volts [V]")
    natural_frequency: Frequency = Field(default=100.0, gt=0)
    damping_ratio: float = Field(default=0.8, gt=0)


class Limits(Part):
    """Limits during a run; crossing one zeroes the outputs and latches a trip."""

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


class Joint(Part):
    """One hydraulic joint: link, linkage, cylinder, valve and its limits.

    The class variables and properties below are common to all kinds of joint, as in
    `rig.model.electric.ElectricJoint`.
    """

    kinds: ClassVar[tuple[str, ...]] = ch.JOINT_KINDS
    position_kind: ClassVar[str] = ch.PISTON
    drive_kind: ClassVar[str] = ch.SPOOL
    simulated_kinds: ClassVar[tuple[str, ...]] = (ch.PISTON, ch.CAP, ch.ROD)
    families: ClassVar[tuple[str, ...]] = ("mechanical", "fluid")
    drive_gain: ClassVar[float] = 0.0

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

    @property
    def position_range(self) -> tuple[float, float]:
        """The piston's ends [m]."""
        return -self.cylinder.stroke / 2, self.cylinder.stroke / 2

    @property
    def sensor_range(self) -> tuple[float, float]:
        """Positions [m] that a sensor may read: slightly beyond the piston's ends.

        By a twentieth of the stroke, and at most half way to where the pins' triangle is flat.
        """
        (low, high), beyond = self.position_range, 0.05 * self.cylinder.stroke
        a, c, middle = self.linkage.base_pin, self.linkage.arm_pin, self.linkage.mid_length
        folded, stretched = middle + low - abs(a - c), a + c - middle - high
        return low - min(beyond, 0.5 * folded), high + min(beyond, 0.5 * stretched)

    def geometry(self, position: Array | float) -> tuple[Array, Array, Array]:
        """Return angle q [rad], G = ds/dq [m] and dG/dq [m/rad] at piston displacement s [m].

        s is limited to `sensor_range`.
        """
        return self.linkage.geometry(np.clip(position, *self.sensor_range))


class Calibration(Part):
    """Date, serial number and certificate of a sensor's last calibration."""

    date: datetime.date
    serial: str = Field(min_length=1, description="serial number of the sensor")
    certificate: str = Field(default="", description="number of the certificate, or who did it")


class _Sensor(Part):
    bits: int = Field(ge=8, le=16)
    delay: Time = Field(default=0.0, ge=0, description="delay of the channel [s]")


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


def converter_step(sensor: AnySensor) -> float:
    """Return the step of a sensor's converter, from one code to the next [its unit]."""
    low, high = sensor.range
    return float((high - low) / ((1 << sensor.bits) - 1))


class Sensors(Part):
    """One description per kind of channel; those of the bench are optional."""

    spool: SpoolSensor
    piston: PistonSensor
    chamber_pressure: PressureSensor
    supply_pressure: PressureSensor | None = None
    oil_temperature: TemperatureSensor | None = None
    skew: Time = Field(default=0.0, ge=0, description="between neighbours in the multiplexer [s]")
    calibrations: dict[str, Calibration] = Field(default={}, description="by channel: piston_1")

    @model_validator(mode="after")
    def _calibrated(self) -> Self:
        for name in self.calibrations:
            try:
                ch.kind_of(name)
            except ValueError as error:
                raise ValueError(f"calibrations {name}: {error}") from error
        return self

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
        sensors = {
            ch.SPOOL: self.spool,
            ch.PISTON: self.piston,
            ch.CAP: self.chamber_pressure,
            ch.ROD: self.chamber_pressure,
            ch.SUPPLY: self.supply_pressure,
            ch.TEMPERATURE: self.oil_temperature,
        }[kind]
        if sensors is None:
            raise KeyError(f"this rig has no sensor for {kind!r}")
        return sensors


class Supply(Part):
    """The pump: set pressure and flow limit."""

    # Outside these bounds the unit is wrong: 160 Pa for 160 bar.
    pressure: Pressure = Field(ge=1e5, le=1e8)
    flow: Flow = Field(gt=0)


class Oil(Part):
    """The working fluid."""

    name: str
    # Outside these bounds the unit is wrong: 860 g/m^3, or 45 K for 45 degC.
    density: Density = Field(ge=500, le=2000)
    temperature: Temperature = Field(ge=-60, le=200)
    temperature_band: TemperatureDifference = Field(default=2.0, ge=0)


LOCALHOST: Final = "127.0.0.1"
PORT: Final = 5020  # of a bench on TCP, if its rig file has none
_PLACES: Final = ("bus", "device", "run")  # keys that name the device, other keys beside them


class BenchLimits(Part):
    """Limits of quantities of the whole bench; an omitted limit is none."""

    supply_pressure: tuple[Pressure, Pressure] | None = None
    oil_temperature: tuple[Temperature, Temperature] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in type(self).model_fields:
            low, high = getattr(self, name) or (0.0, 1.0)
            if not low < high:
                raise ValueError(f"limits {name}: lower {low:g} is not below upper {high:g}")
        return self


class Wire(Part):
    """The connection to the bench: the kind of wire, times, and the settings of its driver.

    Other keys are kept as in the file and read by the driver (`drivers.registry`).
    """

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    kind: str = Field(default="modbus-tcp", pattern=r"^[a-z][a-z0-9-]*$")
    timeout: Time = Field(default=1.0, gt=0, description="answer expected within [s]")
    watchdog: Time = Field(default=0.5, gt=0, description="host silence after which outputs zero")
    jitter: Time | None = Field(
        default=None, ge=0, description="of a host-timed device's samples, standard deviation [s]"
    )

    @field_validator("watchdog")
    @classmethod
    def _within_the_registers_range(cls, value: float) -> float:
        low, high = WATCHDOG_RANGE
        if not low <= value <= high:
            raise ValueError(f"watchdog {value:g} s: a device takes {low:g} s to {high:g} s")
        return value

    @field_validator("timeout")
    @classmethod
    def _ends_while_a_watchdog_could_run(cls, value: float, info: ValidationInfo) -> float:
        """Reject a wait for an answer during which no device would still be driven.

        The host can neither stop nor trip while it waits. Stored runs may state more.
        """
        longest = WATCHDOG_RANGE[1]
        if is_from_file(info) and value > longest:
            raise ValueError(
                f"timeout {value:g} s: expected at most {longest:g} s, the longest watchdog of a "
                "device: the host waits so long before it says that a device is lost"
            )
        return value

    @property
    def settings(self) -> dict[str, Any]:
        """The keys that the driver of this kind reads."""
        return dict(self.model_extra or {})

    def reached_by(self, kind: str, settings: Mapping[str, Any]) -> Wire:
        """Return a wire with the same times, of this kind and with these settings."""
        times = {"timeout": self.timeout, "watchdog": self.watchdog, "jitter": self.jitter}
        return Wire(kind=kind, **times, **settings)

    @property
    def endpoint(self) -> str:
        """The bench's address as `--endpoint` reads it: bus, device file, run, or host and port.

        Other settings follow behind ``?``, without tables, for which `--endpoint` has no form. Two
        benches of one computer must differ before it: trips are stored and benches locked by that.
        A kind with none of these keys has what names its device: texts, as `address: COM3`, or the
        card of its outputs' channels, as `Dev1/ao0`.
        """
        at = self.settings
        for place in _PLACES:
            if place in at:
                rest = urlencode(_scalars(at, place), safe="/")
                return f"{self.kind}://{at[place]}{'?' if rest else ''}{rest}"
        if "host" not in at and "port" not in at and (named := _cards(at) or _texts(at)):
            return f"{self.kind}://{','.join(named)}"
        host = str(at.get("host", LOCALHOST))
        host = f"[{host}]" if ":" in host else host
        return f"{self.kind}://{host}:{at.get('port', PORT)}"


def _scalars(settings: Mapping[str, Any], place: str) -> dict[str, str]:
    """Return the settings beside `place` that are single values, as text."""
    beside = {key: value for key, value in settings.items() if key != place}
    return {k: str(v) for k, v in beside.items() if isinstance(v, str | int | float)}


def _cards(settings: Mapping[str, Any]) -> list[str]:
    """Return the first part of the channels of outputs, such as Dev1 of Dev1/ao0."""
    outputs = settings.get("outputs")
    places = outputs.values() if isinstance(outputs, dict) else ()
    channels = [str(p["channel"]) for p in places if isinstance(p, dict) and "channel" in p]
    return sorted({channel.partition("/")[0] for channel in channels})


def _texts(settings: Mapping[str, Any]) -> list[str]:
    return [value for value in settings.values() if isinstance(value, str)]
