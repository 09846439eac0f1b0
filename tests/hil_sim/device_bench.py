"""A device with a clock in hand, and what a host says to it."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from hil_sim.device.device import Device
from hil_sim.device.laws import Refused
from hil_sim.device.register_map import DeviceRegisters
from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal
from tests.hil_sim.block_samples import unpack_samples
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

RIG = seed_rig(watchdog=0.5)
HOST, OTHER = "host", "other"


class Bench:
    """A device with a settable clock, and a host's words for what it does."""

    def __init__(self, *, realtime: bool, plant: Any = None) -> None:
        self.now = 100.0
        self.plant = plant if plant is not None else IntegratorPlant(RIG)
        self.device = Device(RIG, self.plant, realtime=realtime, clock=lambda: self.now)
        self.map = DeviceRegisters(self.device)
        self.beats = 0

    def pass_time(self, seconds: float, step: float = 0.02) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + step, end)
            self.device.poll()

    def write(self, register: reg.Register, *words: int, client: str = HOST) -> None:
        self.map.write(client, register.address, struct.pack(f">{len(words)}H", *words))

    def law(self, joint: int, **values: float) -> None:
        words = reg.float_words([values.get(name, 0.0) for name in reg.LAW_FIELDS])
        address = reg.LAWS.address + reg.LAW_WORDS * (joint - 1)
        self.map.write(HOST, address, struct.pack(f">{len(words)}H", *words))

    def drive(self, volts: float) -> None:
        self.law(1, bias=volts, limit=5.0)
        self.write(reg.CONTROL_APPLY, reg.APPLY)

    def exchange(self, acknowledge: int = 0xFFFF) -> tuple[reg.BlockHeader, np.ndarray]:
        self.beats += 1
        self.write(reg.CONTROL_ACK, acknowledge, self.beats & 0xFFFF)
        words = self.device.layout.words
        data = self.map.read(HOST, reg.BLOCK.address, words)
        assert len(data) == 2 * words
        _, commands = unpack_samples(data[10:], self.device.layout)
        return reg.unpack_header(data), commands

    def status(self, register: reg.Register) -> int:
        data = self.map.read(OTHER, register.address, register.words)
        return int.from_bytes(data, "big")

    def stream(self) -> None:
        self.write(reg.CONTROL_STREAM, reg.STREAM_START)


def expect_refusal(reason: Refusal, call: Any, *arguments: Any, **keywords: Any) -> None:
    with pytest.raises(Refused) as caught:
        call(*arguments, **keywords)
    assert caught.value.reason == reason
