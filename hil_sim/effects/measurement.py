"""Effects of measurement: a channel that lags, a wrong gain, an offset."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from hil_sim.effects.base import PlantEffect, Tables, read_with_unit
from rig.model.channels import kind_of, unit_of
from rig.model.quantity import Ratio, Time


class _Sensor(PlantEffect):
    channel: str

    @field_validator("channel")
    @classmethod
    def _measured(cls, value: str) -> str:
        if kind_of(value)[0] == "command":
            raise ValueError(f"{value!r} is put out, not measured; expected one like piston_1")
        return value


class ChannelDelay(_Sensor):
    """The channel lags the world by this much more."""

    drawn_at = "pressure"
    sizes: ClassVar = {"time": (1e-3, 6e-3)}

    name: Literal["channel_delay"]
    time: Time = Field(gt=0, le=0.2)

    def apply(self, t: Tables) -> None:
        """Put the effect into the plant's tables."""
        t.channels["lag"][t.rig.channels.index(self.channel)] += self.time


class SensorGain(_Sensor):
    """The channel reads the true value times `gain`."""

    drawn_at = "pressure"
    sizes: ClassVar = {"gain": (1.01, 1.08)}

    name: Literal["sensor_gain"]
    gain: Ratio = Field(gt=0)

    def apply(self, t: Tables) -> None:
        """Put the effect into the plant's tables."""
        t.channels["gain"][t.rig.channels.index(self.channel)] *= self.gain


class SensorOffset(_Sensor):
    """The channel reads `offset` too much, in its own unit."""

    drawn_at = "pressure"
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
        """Put the effect into the plant's tables."""
        t.channels["offset"][t.rig.channels.index(self.channel)] += self.offset
