"""The interface between a bench and any device: outputs to valves, blocks of samples back.

The device owns the sample clock. It evaluates one output law per joint at every tick,

    v = clip(gain wave[(tick - start) mod period] + bias + position_gain (setpoint - s), +-limit)

so that waveforms are device-timed, and streams samples as numbered blocks. For a device that only
reads and writes, the driver does the same at the host's rate (`drivers.polled`); the class
attribute `host_timed` states which of the two applies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any, ClassVar, Protocol, Self, runtime_checkable
from urllib.parse import SplitResult, parse_qsl

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rig.model.parse import NO_NUMBER, InputError, boolean_numbers, problem_text
from rig.model.parts import Part, Wire
from rig.model.rig import Rig

Array = NDArray[np.float64]


class DeviceError(Exception):
    """The device sent an invalid answer, refused a command, or is not the one described."""


class DeviceLost(DeviceError):
    """The device does not answer, or no longer."""


class DeviceBusy(DeviceError):
    """Another client has control of the device; this one may only zero its outputs."""


class PackageMissing(InputError):
    """The package that a kind of wire needs is not installed on this computer."""


@runtime_checkable
class KnowsSetup(Protocol):
    """A driver that can tell without its device that a session will fail."""

    def setup_problem(self) -> str | None:
        """Return the key of section `wire` at fault and what was expected, None if all is there."""


@runtime_checkable
class ReportsDoubts(Protocol):
    """A driver that can name channels whose values suggest a wrong setting."""

    def doubts(self) -> Mapping[str, str]:
        """Return the suspected setting by channel; reads, moves nothing. Raises DeviceError."""


@runtime_checkable
class MayLackWatchdog(Protocol):
    """A driver of devices of which some do not zero their outputs by themselves."""

    @property
    def lacks_watchdog(self) -> bool:
        """Whether nothing zeroes the outputs when the host or the wire fails."""


def zeroed_without_host(driver: Driver, watchdog: float) -> str:
    """Say what zeroes the outputs of a device that the host cannot reach, after `watchdog` [s]."""
    if isinstance(driver, MayLackWatchdog) and driver.lacks_watchdog:
        return "this device has no watchdog: NOTHING ELSE zeroes its outputs"
    return f"a watchdog of the device, if it is set, zeroes them in {watchdog:g} s"


@dataclass(frozen=True)
class DeviceInfo:
    """The connected device: identity, size and clock."""

    identity: str
    joints: int
    channels: int
    sample_rate: float
    block_samples: int
    virtual_time: bool

    @classmethod
    def of(cls, rig: Rig, identity: str, block_samples: int, *, virtual_time: bool) -> Self:
        """Return a device that has the rig's size and clock."""
        joints, channels = len(rig.joints), len(rig.channels)
        return cls(identity, joints, channels, rig.sample_rate, block_samples, virtual_time)


@dataclass(frozen=True)
class OutputLaw:
    """The law of one joint's valve output; all zeros is a closed valve.

    `gain` scales the uploaded waveform, `bias` [V] is added, `position_gain` [V/m] drives the
    piston to `setpoint` [m], `limit` [V] bounds the sum either way.
    """

    gain: float = 0.0
    bias: float = 0.0
    position_gain: float = 0.0
    setpoint: float = 0.0
    limit: float = 0.0


OFF = OutputLaw()


@dataclass(frozen=True)
class ActiveLaw(OutputLaw):
    """One joint's output law with its waveform [V] and the tick of the waveform's first sample."""

    wave: Array = field(default_factory=lambda: np.zeros(1))
    start: int = 0

    def volts(self, tick: int, position: float) -> float:
        """Return the output [V] at a tick and a position [m or rad]."""
        command = self.gain * self.wave[(tick - self.start) % len(self.wave)] + self.bias
        command += self.position_gain * (self.setpoint - position)
        return float(min(max(command, -self.limit), self.limit))


def check_count(laws: Sequence[OutputLaw], rig: Rig) -> None:
    """Raise DeviceError unless there is one law per joint."""
    if len(laws) != len(rig.joints):
        raise DeviceError(f"{len(laws)} laws for a rig of {len(rig.joints)} joints")


def possible_laws(laws: Sequence[OutputLaw], rig: Rig) -> tuple[OutputLaw, ...]:
    """Return one law per joint; raises DeviceError naming the joint of an impossible law."""
    check_count(laws, rig)
    for number, (law, joint) in enumerate(zip(laws, rig.joints, strict=True), start=1):
        if not all(math.isfinite(value) for value in astuple(law)):
            raise DeviceError(f"law of joint {number} has a value that is not finite: {law}")
        if not 0.0 <= law.limit <= joint.valve.command_range:
            raise DeviceError(
                f"law of joint {number} has the limit {law.limit:g} V, expected 0 to "
                f"{joint.valve.command_range:g} V"
            )
    return tuple(laws)


def possible_wave(joint: int, wave: Array, rig: Rig) -> Array:
    """Return a copy of the waveform [V] of a joint (0-based); raises DeviceError if impossible."""
    if not 0 <= joint < len(rig.joints):
        raise DeviceError(f"no joint {joint + 1} on a rig of {len(rig.joints)}")
    volts = np.array(wave, dtype=np.float64).ravel()
    most = rig.joints[joint].valve.command_range
    if not len(volts):
        raise DeviceError(f"waveform of joint {joint + 1} is empty")
    wrong = np.flatnonzero(~(np.abs(volts) <= most))
    if len(wrong):
        raise DeviceError(
            f"waveform of joint {joint + 1}: sample {wrong[0]} is {volts[wrong[0]]:g} V, "
            f"outside the converter's range of +-{most:g} V"
        )
    return volts


@dataclass(frozen=True)
class SampleBlock:
    """Consecutive samples, decoded to SI, in the order of `Rig.recorded`.

    `tick` is the device's sample counter at the first row (an unbroken stream continues by
    `len(data)`); `data` has shape (n, channels + joints): measured channels, then the commands
    put out [V]; `saturated` marks samples at an end of their converter's range, same shape as the
    measured part; `backlog` counts the blocks still waiting in the device; `tripped` states that
    the device itself has zeroed its outputs (watchdog or fault). A host-timed driver adds
    `read_at`, shape (n,): when each row's own sample was taken [s since tick 0], NaN for an
    interpolated row. `armed` is False where the device reports that no law can put out a voltage;
    if those applied last could, another client has zeroed the outputs.
    """

    sequence: int
    tick: int
    data: Array
    saturated: NDArray[np.bool_]
    backlog: int
    tripped: bool
    read_at: Array | None = None
    armed: bool = True


class WireSettings(Part):
    """The keys of a rig file's section `wire` that one kind of driver reads."""

    @classmethod
    def of(cls, wire: Wire) -> Self:
        """Read the settings of a wire; raises InputError naming the key and what was expected."""
        try:
            settings = cls.model_validate(wire.settings)
        except ValidationError as error:
            problem = error.errors()[0]
            key = ".".join(str(part) for part in problem["loc"])
            known = " ".join(cls.model_fields)
            if problem["type"] == "extra_forbidden":
                usual = "kind timeout watchdog jitter"
                text = f"unknown key of wire {wire.kind}; expected: {usual} {known}"
            elif problem["type"] == "missing":
                text = f"wire {wire.kind} needs it"
            else:
                text = problem_text(problem)
            raise InputError(f"wire: {key}: {text}") from error
        for path in boolean_numbers(wire.settings, settings):
            raise InputError(f"wire: {'.'.join(map(str, path))}: {NO_NUMBER}")
        return settings

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return the settings of an endpoint such as ``modbus-tcp://127.0.0.1:5020``.

        By default KIND://VALUE?KEY=VALUE of the one setting that a rig file must state, and others.
        Raises ValueError where it does not have the form of `example`, or where no single setting
        must be stated.
        """
        needed = [name for name, field in cls.model_fields.items() if field.is_required()]
        value = url.netloc + url.path  # serial://COM3 has no path
        if len(needed) != 1:
            raise ValueError("no single setting names the device")
        if not value:
            raise ValueError(f"no {needed[0]}")
        return {needed[0]: value, **dict(parse_qsl(url.query))}

    example: ClassVar[str] = ""


class Driver(Protocol):
    """A device behind a wire. Every call raises DeviceLost or DeviceError, nothing else.

    A driver is a class of `(wire, rig)`, found by the entry point group ``bramah.drivers`` under
    the name of its kind of wire; its class attribute `settings` is the `WireSettings` it reads.
    `host_timed` is False where the device has the sample clock, waveforms and output laws, True
    where this process has them, with its delays.
    """

    settings: ClassVar[type[WireSettings]]
    host_timed: ClassVar[bool]

    def __init__(self, wire: Wire, rig: Rig) -> None: ...

    def connect(self) -> DeviceInfo:
        """Open the wire, check that the device fits the rig, leave its outputs at zero."""

    def close(self) -> None:
        """Zero the outputs if the device still answers, then close; never raises."""

    def zero_outputs(self) -> None:
        """Put every output to zero now, in any state."""

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of joint `joint`'s (0-based) waveform [V], shape (period,)."""

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws at one tick; `restart` starts the waveforms there. Returns that tick."""

    def start(self) -> None:
        """Start streaming blocks, with new sequence numbers and waveform phase."""

    def read_block(self) -> SampleBlock:
        """Return the next block, waiting for it; also feeds the device's watchdog."""

    def stop(self) -> None:
        """Stop streaming; a host-timed driver then also zeroes the outputs."""

    def trip_cause(self) -> str | None:
        """Return why the device has zeroed its outputs and keeps them so, None if it has not."""

    def reset(self) -> None:
        """Clear a latched trip of the device; only on a person's request."""


@runtime_checkable
class AsksAhead(Protocol):
    """A driver that can request a block before the previous one is processed."""

    def ask_ahead(self) -> None:
        """Request the block that the next `read_block` returns, without waiting; never raises.

        Does nothing in real time, where blocks are measured anyway. To be called only if a
        `read_block` follows: in virtual time the laws in force hold for that block.
        """


@runtime_checkable
class LatchesTrip(Protocol):
    """A driver that can leave its device with a latched trip, which stops any other host too."""

    def close_tripped(self) -> None:
        """Zero the outputs, then close so that the device latches a trip; never raises."""
