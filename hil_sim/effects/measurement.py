"""Effects of measurement: delay or lag of a channel, wrong gain, offset, cross-talk."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from hil_sim.effects.base import PlantEffect, Tables, read_with_unit
from rig.model.channels import channel, kind_of, unit_of
from rig.model.quantity import Ratio, Time


class _Sensor(PlantEffect):
    drawn_at = "pressure"
    channel: str

    @field_validator("channel")
    @classmethod
    def _measured(cls, value: str) -> str:
        if kind_of(value)[0] == "command":
            raise ValueError(f"{value!r} is put out, not measured; expected one like piston_1")
        return value


class ChannelDelay(_Sensor):
    """The channel is delayed by `time` in addition to the rig file's delay."""

    sizes: ClassVar = {"time": (1e-3, 6e-3)}

    name: Literal["channel_delay"]
    time: Time = Field(gt=0, le=0.2)

    def apply(self, t: Tables) -> None:
        t.channels["lag"][t.rig.channels.index(self.channel)] += self.time


class SensorGain(_Sensor):
    """The channel reads the true value times `gain`."""

    sizes: ClassVar = {"gain": (1.01, 1.08)}

    name: Literal["sensor_gain"]
    gain: Ratio = Field(gt=0)

    def apply(self, t: Tables) -> None:
        t.channels["gain"][t.rig.channels.index(self.channel)] *= self.gain


class SensorOffset(_Sensor):
    """The channel reads `offset` too much, in its own unit."""

    sizes: ClassVar = {"offset": (0.03e6, 0.2e6)}
    signed = ("offset",)

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

    def apply(self, t: Tables) -> None:
        t.channels["offset"][t.rig.channels.index(self.channel)] += self.offset


class SensorLag(_Sensor):
    """The channel passes a low-pass filter of this time constant.

    ``pole`` is one, ``poles`` are two equal ones of half of it each.
    """

    sizes: ClassVar = {"time": (1e-3, 6e-3)}
    name: Literal["sensor_lag"]
    time: Time = Field(ge=2e-4, le=0.2)
    form: Literal["pole", "poles"] = "pole"

    def apply(self, t: Tables) -> None:
        k = t.rig.channels.index(self.channel)
        t.channels["filter_time"][k] = self.time
        t.channels["filter_stages"][k] = 1 + (self.form == "poles")


class SensorCrosstalk(_Sensor):
    """The channel reads a share of another channel in addition, in the ratio of their units.

    ``wire`` reads the other as it is, ``coupling`` through a capacitor: high-passed with a time
    constant of a second.
    """

    sizes: ClassVar = {"share": (0.01, 0.06)}
    signed = ("share",)
    name: Literal["sensor_crosstalk"]
    share: Ratio = Field(ge=-0.5, le=0.5)
    other: str | None = None
    form: Literal["wire", "coupling"] = "wire"

    @model_validator(mode="after")
    def _pressure(self) -> Self:
        kind = kind_of(self.channel)[0]
        if not self.other and kind not in ("cap_pressure", "rod_pressure"):
            raise ValueError(f"{self.channel!r}: name the other channel that it reads, as `other`")
        return self

    @property
    def source_channel(self) -> str:
        """The channel read in addition; of a chamber's pressure the other chamber's by default."""
        kind, joint = kind_of(self.channel)
        other = "rod_pressure" if kind == "cap_pressure" else "cap_pressure"
        return self.other or channel(other, joint or 1)

    def apply(self, t: Tables) -> None:
        k = t.rig.channels.index(self.channel)
        t.channels["crosstalk_source"][k] = 1 + t.rig.channels.index(self.source_channel)
        t.channels["crosstalk_share"][k] = self.share
        t.channels["crosstalk_high_pass"][k] = float(self.form == "coupling")
