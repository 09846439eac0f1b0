"""Faults of sensors and wiring, applied to the converter codes of the bench."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from hil_sim.faults.base import Fault
from rig.model.channels import kind_of
from rig.model.quantity import Ratio
from rig.model.rig import Rig
from rig.model.wire.codes import Array, Codes


class ChannelFault(Fault):
    """A fault of one measured channel."""

    channel: str

    def column(self, rig: Rig) -> int:
        """Return the channel's column."""
        return rig.channels.index(self.channel)

    def top(self, rig: Rig) -> int:
        """Return the highest code of the channel's converter."""
        return int((1 << rig.sensors.of(kind_of(self.channel)[0]).bits) - 1)


class SensorStuck(ChannelFault):
    """The channel repeats its last code."""

    name: Literal["sensor_stuck"]

    def distort(
        self, codes: Codes, last: Codes, seconds: Array, rig: Rig, rng: np.random.Generator
    ) -> None:
        """Hold the last code."""
        k = self.column(rig)
        codes[:, k] = last[k]


class SensorDrift(ChannelFault):
    """The channel drifts by `rate` of its range a second."""

    name: Literal["sensor_drift"]
    rate: Ratio = Field(description="of the sensor's range per second, either way")

    def distort(
        self, codes: Codes, last: Codes, seconds: Array, rig: Rig, rng: np.random.Generator
    ) -> None:
        """Add a ramp."""
        k, top = self.column(rig), self.top(rig)
        codes[:, k] = np.clip(codes[:, k] + np.rint(self.rate * top * seconds), 0, top)


class SensorNoise(ChannelFault):
    """The channel is noisy, with a standard deviation of `deviation` of its range."""

    name: Literal["sensor_noise"]
    deviation: Ratio = Field(gt=0)

    def distort(
        self, codes: Codes, last: Codes, seconds: Array, rig: Rig, rng: np.random.Generator
    ) -> None:
        """Add noise."""
        k, top = self.column(rig), self.top(rig)
        noise = rng.normal(0.0, self.deviation * top, len(codes))
        codes[:, k] = np.clip(codes[:, k] + np.rint(noise), 0, top)


class BrokenWire(ChannelFault):
    """The channel's wire is broken: its converter shows the lowest (or highest) code."""

    name: Literal["broken_wire"]
    end: Literal["low", "high"] = "low"

    def distort(
        self, codes: Codes, last: Codes, seconds: Array, rig: Rig, rng: np.random.Generator
    ) -> None:
        """Show the end of the range."""
        codes[:, self.column(rig)] = 0 if self.end == "low" else self.top(rig)


class SwappedChannels(Fault):
    """Two channels of one kind are connected the wrong way round."""

    name: Literal["swapped_channels"]
    channel: str
    other: str

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if kind_of(self.channel)[0] != kind_of(self.other)[0] or self.channel == self.other:
            raise ValueError(f"{self.channel} and {self.other} are not two channels of one kind")
        return self

    def distort(
        self, codes: Codes, last: Codes, seconds: Array, rig: Rig, rng: np.random.Generator
    ) -> None:
        """Exchange the columns."""
        a, b = (rig.channels.index(name) for name in (self.channel, self.other))
        codes[:, [a, b]] = codes[:, [b, a]]
