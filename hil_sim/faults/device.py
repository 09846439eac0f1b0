"""Faults of the device's electronics: a restart, a clock error, a queue overrun."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hil_sim.faults.base import Fault
from rig.model.quantity import Ratio, Time


class DeviceFault(Fault):
    """A fault that the device itself executes (`hil_sim.device.device`), at a block's end."""

    @property
    def place(self) -> str:
        """Its place, as text."""
        return "device"


class Reboots(DeviceFault):
    """The device restarts: outputs zero; laws, waveforms and trips lost; counters at zero.

    It does not answer for `boot` and ends its connections.
    """

    name: Literal["reboots"]
    boot: Time = Field(default=0.2, ge=0)


class ClockDrift(DeviceFault):
    """The device's sample clock is fast by `rate` (slow if negative), in real time only."""

    name: Literal["clock_drift"]
    rate: Ratio = Field(default=1e-3, gt=-0.5, lt=1)


class ClockJump(DeviceFault):
    """The device's sample counter jumps by `step`, without a missing sample."""

    name: Literal["clock_jump"]
    step: Time = 0.1


class QueueOverrun(DeviceFault):
    """The device loses `blocks` blocks of samples before the host has read them."""

    name: Literal["queue_overrun"]
    blocks: int = Field(default=3, ge=1)
