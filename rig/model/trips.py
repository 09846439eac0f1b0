"""Reasons to stop a run: a limit exceeded, an operator, a recorder that cannot write."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from typing import Final

from rig.model.rig import Rig
from rig.model.units import LIMITS, display_unit

FINITE: Final = "finite samples"
SATURATED: Final = "saturated sensor"
GAP: Final = "sample gap"
STALE: Final = "stale data"
DEVICE: Final = "device watchdog or fault"
FROZEN: Final = "frozen sensor"
NOT_FOLLOWING: Final = "spool does not follow"
EMPTY_CHAMBER: Final = "chamber without pressure"
SUPPLY_LOST: Final = "supply lost"
NOTHING_MOVES: Final = "nothing moves"
ABOVE_SUPPLY: Final = "pressure above supply"
DRIFTS: Final = "drift at rest"
NOISY: Final = "noisy sensor"
SWAPPED: Final = "swapped pressures"
SENSOR_DRIFT: Final = "drifting pressure sensor"

_LARGEST = 1e300  # an end beyond this counts as open


@dataclass(frozen=True)
class Violation:
    """A limit and the sample that exceeded it, in SI; `joint` is 1-based, None for the bench.

    `seconds` is the sample's time since the run began, None where nothing is recorded. `within` [s]
    is the time in which the value must have changed, None for a limit of the value itself.
    """

    limit: str
    value: float
    allowed: tuple[float, float]
    unit: str
    joint: int | None
    channel: str
    tick: int
    seconds: float | None = None
    within: float | None = None


def show(value: float, unit: str, digits: int = 4) -> str:
    """Return a value with its display unit: '9.31 MPa'."""
    shown = display_unit(unit, LIMITS)
    return f"{value * shown.scale:.{digits}g} {shown.text}"


def _open(end: float) -> bool:
    return math.isinf(end) or abs(end) > _LARGEST


def _value(violation: Violation) -> str:
    """Return the value, with enough digits to differ from the limits."""
    if not violation.unit:
        return "reported by the device"
    limits = {show(end, violation.unit) for end in violation.allowed}
    shown = (show(violation.value, violation.unit, digits) for digits in range(4, 16))
    return next(
        (text for text in shown if text not in limits), show(violation.value, violation.unit)
    )


def _allowed(violation: Violation) -> str:
    low, high = violation.allowed
    if violation.limit == DEVICE:
        return "nothing but running"
    if violation.within is not None:
        return f"only values that change within {violation.within:g} s while the joint moves"
    if violation.limit == FINITE:
        return "finite numbers only"
    if _open(high):
        return f"at least {show(low, violation.unit)}"
    if _open(low):
        return f"at most {show(high, violation.unit)}"
    shown = display_unit(violation.unit, LIMITS)
    return f"{low * shown.scale:.4g} to {high * shown.scale:.4g} {shown.text}"


def describe(violation: Violation, rig: Rig) -> str:
    """Return a violation as one clause: place, value, time and allowed range."""
    where = "the bench"
    if violation.joint is not None:
        where = f"joint {violation.joint} ({rig.joints[violation.joint - 1].name})"
    subject = f"{violation.channel} of {where}" if violation.channel else where
    if violation.seconds is None:
        time = f"{violation.tick / rig.sample_rate:.4f} s of the device's clock"
    else:
        time = f"{violation.seconds:.4f} s"
    return f"{subject}: {_value(violation)} at {time}, allowed {_allowed(violation)}"


class SafetyTrip(Exception):
    """A limit was exceeded and the outputs are at zero; the message names everything (exit 3).

    `violation` is the frozen data; `limit value allowed unit joint channel tick` are its fields,
    `device_time` [s] is the violating sample's.
    """

    def __init__(self, violation: Violation, rig: Rig) -> None:
        self.violation = violation
        self.limit = violation.limit
        self.value = violation.value
        self.allowed = violation.allowed
        self.unit = violation.unit
        self.joint = violation.joint
        self.channel = violation.channel
        self.tick = violation.tick
        self.device_time = violation.tick / rig.sample_rate
        super().__init__(violation, rig)  # so that it can be pickled

    def __str__(self) -> str:
        """Name the limit, the joint, what was measured and what is allowed."""
        return f"safety trip: limit '{self.limit}', {describe(*self.args)}"


def reset_command(rig: Rig) -> str:
    """Return the command that clears a trip of this rig's bench."""
    at = shlex.quote(rig.wire.endpoint)
    return f"bramah reset --rig {rig.name} --endpoint {at} --reason TEXT"


class Latched(Exception):
    """The bench tripped earlier and the trip is not cleared; nothing moves (exit 3)."""

    def __init__(self, what: str, rig: Rig) -> None:
        super().__init__(f"{what}; examine the bench, then clear it with `{reset_command(rig)}`")


class OperatorStop(Exception):
    """A person (or the system, by SIGTERM) ended the run; the outputs are at zero (exit 130)."""


class RecordingFailed(Exception):
    """Samples can no longer be written; the message is one line (exit 1)."""
