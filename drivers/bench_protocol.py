"""Parts of this project's protocol that all its wires share: identity, waveforms, reasons.

Modbus TCP and the serial line transfer the same values in different frames
(`rig.model.wire.registers`).
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import Array, DeviceError, DeviceInfo, DeviceLost, possible_wave
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.codes import encode_output
from rig.model.wire.registers import Refusal, TripCause

# On the time limit of answers: a device in virtual time waits for a busy computer anyway.
VIRTUAL_TIMEOUT_FACTOR: Final = 10.0
_VERSION = "protocol version"
_TOLERANCE = 1e-6  # registers hold single precision
_IDENTITY = struct.Struct(">IHHHfHHII")


class DeviceRefused(DeviceError):
    """The device understood a request and refused it."""


class DeviceSilent(DeviceLost):
    """No answer came in time; the request may be repeated."""


class AnswerDamaged(DeviceSilent):
    """A damaged answer came in time; the request may be repeated."""


def check_identity(data: bytes, rig: Rig, where: str) -> DeviceInfo:
    """Return the device's identity from the bytes of the identity group (`reg.IDENTITY_SPAN`).

    Raises DeviceError with the first property in which the device at `where` is not the rig's.
    """
    magic, version, joints, channels, rate, samples, virtual, _, converters = _IDENTITY.unpack_from(
        data
    )
    layout = reg.block_layout(len(rig.channels), len(rig.joints))
    name = data[2 * reg.IDENTITY_NAME.address :].rstrip(b"\0").decode("ascii", "replace")
    expected_name = rig.name[: 2 * reg.IDENTITY_NAME.words]
    checks: tuple[tuple[str, object, object, bool], ...] = (
        ("magic number", hex(magic), hex(reg.MAGIC), magic == reg.MAGIC),
        (_VERSION, version, reg.PROTOCOL_VERSION, version == reg.PROTOCOL_VERSION),
        ("rig", repr(name), repr(expected_name), name == expected_name),
        ("joints", joints, len(rig.joints), joints == len(rig.joints)),
        ("channels", channels, len(rig.channels), channels == len(rig.channels)),
        (
            "sample rate [Hz]",
            f"{rate:g}",
            f"{rig.sample_rate:g}",
            abs(rate - rig.sample_rate) <= _TOLERANCE * rig.sample_rate,
        ),
        ("samples per block", samples, layout.samples, samples == layout.samples),
    )
    for what, reported, expected, fits in checks:
        if not fits and what == _VERSION:
            raise DeviceError(
                f"the device at {where} speaks version {reported} of the bench protocol, this "
                f"program version {expected}; update the older of the two"
            )
        if not fits:
            raise DeviceError(
                f"the device at {where} is not the rig described: {what} {reported}, "
                f"expected {expected}"
            )
    if converters != reg.converter_checksum(rig):
        raise DeviceError(
            f"the device at {where} converts with other ranges or bits than the sensors and "
            f"valves of rig {rig.name!r}; start it with the same rig file"
        )
    return DeviceInfo.of(rig, name, samples, virtual_time=bool(virtual))


def wave_codes(
    rig: Rig, joint: int, wave: Array, capacity: int = reg.WAVE_CAPACITY
) -> NDArray[np.int16]:
    """Return the 16-bit codes of a waveform [V] of joint `joint` (0-based).

    Raises DeviceError for a joint that does not exist, more samples than `capacity`, or a voltage
    outside the converter's range.
    """
    volts = possible_wave(joint, wave, rig)
    if len(volts) > capacity:
        raise DeviceError(
            f"waveform of joint {joint + 1} has {len(volts)} samples; "
            f"the device takes 1 to {capacity}"
        )
    limit = rig.joints[joint].valve.command_range
    return encode_output(volts, limit, reg.WAVE_BITS).astype(np.int16)


def number_in(data: bytes, register: reg.Register, first: int = reg.STATUS_SPAN[0]) -> int:
    """Return the number in an unsigned register from the bytes of the registers from `first` on."""
    offset = 2 * (register.address - first)
    return int.from_bytes(data[offset : offset + 2 * register.words], "big")


def trip_text(status: bytes) -> str | None:
    """Return why and when a device has zeroed its outputs, None if it has not.

    `status` is the bytes of the status group (`reg.STATUS_SPAN`).
    """
    cause = number_in(status, reg.STATUS_CAUSE)
    if cause == TripCause.NONE:
        return None
    known = cause in TripCause.__members__.values()
    text = reg.TRIP_TEXT[TripCause(cause)] if known else f"cause {cause}"
    return f"{text} (at sample {number_in(status, reg.STATUS_TRIP_TICK)})"


def refusal_text(reason: Refusal, trip: str | None) -> str:
    """Return why a device refused; `trip` is the cause of its trip, if it has tripped."""
    if reason == Refusal.TRIPPED:
        return f"tripped: {trip}; find the cause, then reset it"
    return reg.REFUSAL_TEXT[reason]
