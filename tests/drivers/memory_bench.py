"""A correct bench in memory: a device with trips, watchdog and acknowledged blocks, its driver, and
a link between them that can be cut and spoiled. Mutants are made of it (tests/drivers/mutants.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import ClassVar, TypeVar

import numpy as np

from drivers.base import (
    OFF,
    Array,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    SampleBlock,
)
from drivers.conformance import HEALTHY, Capabilities, DeviceUnderTest, Subject
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire.codes import decode_output, encode_output
from tests.hil_sim.integrator import SPEED_PER_VOLT, seed_rig

SAMPLES = 10
FAULTS = ("lose one", "garbage", "close", "silent")
Answer = TypeVar("Answer")


class MemoryDevice:
    """Integrating pistons behind output laws; time passes only when a block is asked for."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.joints = len(rig.joints)
        self.tick = 0
        self.piston = np.zeros(self.joints)
        self.stuck: int | None = None  # the channel that reads its top end
        self.waves: list[Array] = [np.zeros(1)] * self.joints  # as uploaded
        self.active: list[Array] = [np.zeros(1)] * self.joints  # as played
        self.laws: list[OutputLaw] = [OFF] * self.joints
        self.origin = 0
        self.streaming = False
        self.sequence = 0
        self.waiting: SampleBlock | None = None
        self.cause: str | None = None
        self.watchdog: float | None = None

    # -- what a host asks -------------------------------------------------------------------

    def zero(self) -> None:
        self.laws = [OFF] * self.joints

    def upload(self, joint: int, wave: Array) -> None:
        self.waves[joint] = wave

    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        if self.cause is not None and any(law.limit > 0.0 for law in laws):
            raise DeviceError(f"tripped: {self.cause}")
        self.laws, self.active = list(laws), list(self.waves)
        if restart:
            self.origin = self.tick
        return self.tick

    def start(self) -> None:
        self.streaming, self.sequence, self.waiting = True, 0, None
        self.origin = self.tick

    def stop(self) -> None:
        self.streaming, self.waiting = False, None

    def reset(self) -> None:
        self.cause = None

    def read(self, acknowledged: int) -> SampleBlock | None:
        if not self.streaming:
            return None
        if self.waiting is None or self.waiting.sequence == acknowledged:
            self.waiting = self.block()
        return self.waiting

    # -- what happens by itself -------------------------------------------------------------

    def block(self) -> SampleBlock:
        first = self.tick
        data, marks = self.advance(SAMPLES)
        block = SampleBlock(self.sequence, first, data, marks, 0, self.cause is not None)
        self.sequence += 1
        return block

    def advance(self, count: int) -> tuple[Array, np.ndarray]:
        data = np.zeros((count, len(self.rig.recorded)))
        for row in range(count):
            data[row, : len(self.rig.channels)] = self.measured()
            volts = [self.command(joint) for joint in range(self.joints)]
            data[row, len(self.rig.channels) :] = volts
            self.piston = self.piston + SPEED_PER_VOLT * np.array(volts) / self.rig.sample_rate
            self.tick += 1
        return data, self.marks(data)

    def measured(self) -> Array:
        values = np.full(len(self.rig.channels), 1.0)
        for joint in range(self.joints):
            values[self.rig.channels.index(f"piston_{joint + 1}")] = self.piston[joint]
        if self.stuck is not None:
            values[self.stuck] = self.top()[self.stuck]
        return values

    def top(self) -> Array:
        kinds = [ch.kind_of(name)[0] for name in self.rig.channels]
        return np.array([self.rig.sensors.of(kind).range[1] for kind in kinds])

    def marks(self, data: Array) -> np.ndarray:
        found: np.ndarray = data[:, : len(self.rig.channels)] >= self.top()
        return found

    def command(self, joint: int) -> float:
        law, wave, valve = self.laws[joint], self.active[joint], self.rig.joints[joint].valve
        volts = law.gain * wave[(self.tick - self.origin) % len(wave)] + law.bias
        volts += law.position_gain * (law.setpoint - self.piston[joint])
        volts = min(max(volts, -law.limit), law.limit)
        code = encode_output(volts, valve.command_range, valve.command_bits)
        return float(decode_output(code, valve.command_range, valve.command_bits))

    def trip(self, why: str) -> None:
        if self.streaming or any(law.limit > 0.0 for law in self.laws):
            self.cause = self.cause or why
        self.zero()

    def host_gone(self) -> None:
        self.trip("the host's connection ended")
        self.stop()

    def host_silent(self) -> None:
        if self.watchdog is not None:
            self.trip("watchdog")


class Link:
    """The wire: carries a request to the device and its answer back, unless something is wrong."""

    def __init__(self, device: MemoryDevice) -> None:
        self.device = device
        self.fault = HEALTHY
        self.session: object | None = None

    def open(self, host: object) -> None:
        if self.session is not None:
            raise DeviceBusy("another client has control")
        self.session = host

    def end(self, host: object | None) -> None:
        if self.session is not None and self.session is host:
            self.session = None
            self.device.host_gone()

    def cut(self) -> None:
        self.end(self.session)

    def ask(self, host: object, request: Callable[[MemoryDevice], Answer]) -> Answer:
        if self.session is not host:
            raise DeviceLost("the connection is closed")
        answer = request(self.device)
        if self.fault in ("lose one", "silent"):
            self.fault = HEALTHY if self.fault == "lose one" else self.fault
            raise TimeoutError
        if self.fault == "garbage":
            self.end(host)
            raise DeviceError("the answer is garbage")
        if self.fault == "close":
            self.end(host)
            raise DeviceLost("the connection ended")
        return answer


class MemoryDriver:
    """The correct driver of that bench: asks twice, takes each block once, ends safe."""

    host_timed: ClassVar[bool] = False

    def __init__(self, link: Link, rig: Rig) -> None:
        self.link, self.rig = link, rig
        self.acknowledged = -1

    def ask(self, request: Callable[[MemoryDevice], Answer]) -> Answer:
        for _ in range(2):
            with suppress(TimeoutError):
                return self.link.ask(self, request)
        self.link.end(self)
        raise DeviceLost("the device has not answered")

    def connect(self) -> DeviceInfo:
        self.link.open(self)
        try:
            self.check_identity()
            self.ask(self.set_watchdog)
            self.ask(lambda device: device.zero())
            self.ask(lambda device: device.stop())
        except BaseException:
            self.link.end(self)
            raise
        return DeviceInfo.of(self.rig, "memory", SAMPLES, virtual_time=True)

    def check_identity(self) -> None:
        found = self.ask(lambda device: device.rig)
        for what in ("sample_rate", "channels"):
            if getattr(found, what) != getattr(self.rig, what):
                raise DeviceError(f"another rig: {what}")

    def set_watchdog(self, device: MemoryDevice) -> None:
        device.watchdog = self.rig.wire.watchdog

    def close(self) -> None:
        try:
            with suppress(DeviceError):
                self.ask(lambda device: device.zero())
                self.ask(lambda device: device.stop())
        finally:
            self.link.end(self)

    def zero_outputs(self) -> None:
        if self.link.session is self:
            try:
                self.ask(lambda device: device.zero())
            except DeviceError:
                pass
            else:
                return
        self.link.open(self)
        self.ask(lambda device: device.zero())

    def upload(self, joint: int, wave: Array) -> None:
        if not 0 <= joint < len(self.rig.joints):
            raise DeviceError(f"no joint {joint + 1}")
        most = self.rig.joints[joint].valve.command_range
        if len(wave) == 0 or not (np.abs(wave) <= most).all():
            raise DeviceError("a waveform that cannot be put out")
        self.ask(lambda device: device.upload(joint, np.array(wave)))

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        self.check(laws)
        return self.ask(lambda device: device.apply(laws, restart))

    def check(self, laws: Sequence[OutputLaw]) -> None:
        if len(laws) != len(self.rig.joints):
            raise DeviceError(f"{len(laws)} laws")
        for law, joint in zip(laws, self.rig.joints, strict=True):
            numbers = (law.gain, law.bias, law.position_gain, law.setpoint, law.limit)
            if not all(math.isfinite(number) for number in numbers):
                raise DeviceError("a law that is not finite")
            if not 0.0 <= law.limit <= joint.valve.command_range:
                raise DeviceError("a limit that cannot be kept")

    def start(self) -> None:
        self.ask(lambda device: device.start())
        self.acknowledged = -1

    def stop(self) -> None:
        self.ask(lambda device: device.stop())

    def read_block(self) -> SampleBlock:
        block = self.ask(lambda device: device.read(self.acknowledged))
        if block is None:
            raise DeviceError("the device does not stream")
        self.acknowledged = block.sequence
        return block

    def trip_cause(self) -> str | None:
        return self.ask(lambda device: device.cause)

    def reset(self) -> None:
        self.ask(lambda device: device.reset())


def memory_subject(
    driver: type[MemoryDriver] = MemoryDriver,
    device: type[MemoryDevice] = MemoryDevice,
) -> Subject:
    """Return the bench as a subject of the conformance checks, everything claimed."""

    @contextmanager
    def make() -> Iterator[DeviceUnderTest]:
        rig = seed_rig()
        found = device(rig)
        link = Link(found)

        def outputs() -> list[float]:
            return [found.command(joint) for joint in range(found.joints)]

        def spoil(fault: str) -> None:
            link.fault = fault

        def saturate() -> int:
            found.stuck = rig.channels.index("cap_pressure_2")
            return found.stuck

        yield DeviceUnderTest(
            rig,
            lambda wanted: driver(link, wanted),  # type: ignore[arg-type, return-value]
            outputs=outputs,
            cut=link.cut,
            silence=found.host_silent,
            spoil=spoil,
            faults=FAULTS,
            lost=("silent", "close"),
            saturate=saturate,
        )

    return Subject("memory", make, Capabilities())
