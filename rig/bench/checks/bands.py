"""Roles of the joints and bands of every channel: the values without a warning, without a trip.

A violation is reported when more than `delay` consecutive samples are outside (0: the first one).
All channels of a block are checked at once; runs of samples continue across blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.bench.settings import GuardSettings
from rig.model import channels as ch
from rig.model.alarms.bands import AlarmBand, Range, ends
from rig.model.rig import Rig

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]
_HUGE = float(np.finfo(np.float64).max)  # finite, so that an infinite sample still violates it
_NO_BAND = AlarmBand()
_STROKE_MARGIN = 0.02  # share of the stroke: compliance of the end stop and offset of the sensor


@dataclass(frozen=True)
class JointRole:
    """The present role of a joint.

    The piston of an `excited` joint must stay within `limits.piston`; any other may reach the ends
    of its stroke, also that of a `jogged` one, which a person moves. A locked piston must stay
    within `tolerance` [m] of `locked_at` [m].
    """

    excited: bool = False
    jogged: bool = False
    locked_at: float | None = None
    tolerance: float = math.inf

    @property
    def driven(self) -> bool:
        """Whether a command moves the joint, of a protocol or of a person."""
        return self.excited or self.jogged

    @property
    def locked(self) -> bool:
        """Whether the joint is locked."""
        return self.locked_at is not None and math.isfinite(self.tolerance)


FREE = JointRole()
EXCITED = JointRole(excited=True)
JOGGED = JointRole(jogged=True)


def piston_bounds(role: JointRole, rig: Rig, joint: int) -> tuple[str, float, float]:
    """Return (name of the limit, lowest, highest [m]) of a joint's piston in its role."""
    part = rig.joints[joint]
    if role.locked_at is not None and role.locked:
        return "lock", role.locked_at - role.tolerance, role.locked_at + role.tolerance
    if role.excited:
        return "piston", *part.limits.piston
    reach = part.cylinder.stroke * (0.5 + _STROKE_MARGIN)
    return "stroke end", -reach, reach


def run_lengths(marks: Flags, before: Counts) -> Counts:
    """Return the length of the run of marks ending at each row, (n, channels) as `marks`.

    `before` (channels,) is the length of the run at the end of the previous block.
    """
    rows = np.arange(len(marks))[:, None]
    last_clear = np.maximum.accumulate(np.where(marks, -1, rows), axis=0)
    runs = np.where(last_clear < 0, rows + 1 + before, rows - last_clear)
    return runs.astype(np.int64)


@dataclass(frozen=True)
class Bounds:
    """Lower and upper ends of the bands of all recorded channels, (channels,) each."""

    low: Array
    high: Array

    def outside(self, data: Array) -> Flags:
        """Mark the samples outside their bands; NaN is outside."""
        inside = (data >= self.low) & (data <= self.high)
        return ~inside

    def contain(self, least: Array, most: Array) -> bool:
        """Return whether `least` and `most`, (channels,) each, are inside the bands; NaN is not.

        True for most blocks, and three times as fast as checking each sample.
        """
        inside = np.count_nonzero(least >= self.low) + np.count_nonzero(most <= self.high)
        return bool(inside == 2 * len(self.low))

    def within(self, other: Bounds) -> Bounds:
        """Return the intersection of both bands."""
        return Bounds(np.maximum(self.low, other.low), np.minimum(self.high, other.high))

    def of(self, column: int) -> Range:
        """Return the band of one channel."""
        return float(self.low[column]), float(self.high[column])


class Delayed:
    """Finds samples that have been outside for longer than a delay, across blocks."""

    def __init__(self, delay: Counts) -> None:
        self._delay = delay
        self.forget()

    def forget(self) -> None:
        """Reset: the next samples do not continue the previous ones."""
        self._runs: Counts = np.zeros(len(self._delay), dtype=np.int64)

    def over(self, outside: Flags) -> Flags | None:
        """Mark the samples outside for longer than the delay; None if there are none."""
        if not outside.any():
            self.forget()
            return None
        runs = run_lengths(outside, self._runs)
        self._runs = runs[-1]
        over: Flags = runs > self._delay
        return over if over.any() else None


def first_of(marks: Flags) -> tuple[int, int]:
    """Return (row, column) of the first mark in time."""
    row = int(np.argmax(marks.any(axis=1)))
    return row, int(np.argmax(marks[row]))


def trip_bounds(rig: Rig, roles: tuple[JointRole, ...]) -> Bounds:
    """Return each channel's trip band: its limits for the joint's role, narrowed by `alarms`."""
    return _bounds(_trip_band(rig, roles, name) for name in rig.recorded)


def warning_bounds(rig: Rig, roles: tuple[JointRole, ...], settings: GuardSettings) -> Bounds:
    """Return the warning band of each channel: from `alarms`, or a share of its limits."""
    return _bounds(_warning_band(rig, roles, name, settings) for name in rig.recorded)


def _bounds(bands: object) -> Bounds:
    low, high = np.array(list(bands), dtype=np.float64).T  # type: ignore[call-overload]
    return Bounds(np.maximum(low, -_HUGE), np.minimum(high, _HUGE))


def _trip_band(rig: Rig, roles: tuple[JointRole, ...], name: str) -> Range:
    kind, joint = ch.kind_of(name)
    low, high = rig.limits_of(name)
    if joint is not None and kind == ch.PISTON:
        _, low, high = piston_bounds(roles[joint - 1], rig, joint - 1)
    elif joint is not None and kind == ch.COMMAND:  # the output converter may round up by one step
        valve = rig.joints[joint - 1].valve
        step = valve.command_range / ((1 << (valve.command_bits - 1)) - 1)
        low, high = low - step, high + step
    stated = ends(rig.alarms.channels.get(name, _NO_BAND).trip)
    return max(low, stated[0]), min(high, stated[1])


def _warning_band(
    rig: Rig, roles: tuple[JointRole, ...], name: str, settings: GuardSettings
) -> Range:
    stated = rig.alarms.channels.get(name, _NO_BAND).warning
    if stated is not None:
        return ends(stated)
    kind, joint = ch.kind_of(name)
    share = rig.alarms.warning_share
    if joint is not None:
        return _joint_warning(rig, roles[joint - 1], name, share)
    limits = rig.limits_of(name)
    if math.isfinite(limits[0]):
        return towards_zero(limits, share)
    if kind == ch.SUPPLY:
        low, high = settings.supply_warning
        return low * rig.supply.pressure, high * rig.supply.pressure
    width = settings.oil_warning * rig.oil.temperature_band
    return rig.oil.temperature - width, rig.oil.temperature + width


def _joint_warning(rig: Rig, role: JointRole, name: str, share: float) -> Range:
    kind, _ = ch.kind_of(name)
    if kind in (ch.CAP, ch.ROD):
        return towards_zero(rig.limits_of(name), share)
    if kind == ch.PISTON and role.locked_at is not None and role.locked:
        reach = share * role.tolerance
        return role.locked_at - reach, role.locked_at + reach
    if kind == ch.PISTON and role.excited:
        return towards_zero(rig.limits_of(name), share)
    return -_HUGE, _HUGE  # normal conditions: a command at its limit, a free piston at its end


def towards_zero(limits: Range, share: float) -> Range:
    """Return limits narrowed by `share`: 9 to 8.1 MPa at 0.9; a positive low limit is raised."""
    low, high = limits
    return (low * share if low < 0 else low / share), (high * share if high > 0 else high / share)


def delays(rig: Rig, settings: GuardSettings) -> tuple[Counts, Counts]:
    """Return the (warning, trip) delays [samples] of all recorded channels, (channels,) each."""
    out = []
    for name in rig.recorded:
        band = rig.alarms.channels.get(name, _NO_BAND)
        warning = settings.warning_delay if band.warning_delay is None else band.warning_delay
        trip = band.trip_delay or 0.0
        out.append((round(warning * rig.sample_rate), round(trip * rig.sample_rate)))
    warnings, trips = np.array(out, dtype=np.int64).T
    return warnings, trips


def inner_bounds(rig: Rig, outer: Bounds, settings: GuardSettings) -> Bounds:
    """Return the warning bands narrowed by each channel's hysteresis: inside, a warning ends."""
    widths = []
    for column, name in enumerate(rig.recorded):
        low, high = outer.of(column)
        stated = rig.alarms.channels.get(name, _NO_BAND).dead_band
        default = settings.dead_band * (high - low) if high - low < _HUGE else 0.0
        widths.append(default if stated is None else stated)
    return Bounds(outer.low + np.array(widths), outer.high - np.array(widths))
