"""Alarms as an operator meets them: states, first cause and consequences; data and functions.

The states are those of ISA-18.2 (2016, 5.6): an alarm is *active* until somebody acknowledges it
(*acknowledged*) or the value comes back (*returned*); both together make it *normal* again, and it
leaves the table. A trip is *latched*: it stays, whatever the value does, until it is reset with a
reason, and it can be reset only after it was acknowledged. Acknowledging says "I have seen it";
resetting says "its cause is removed". An alarm that begins while an earlier one of the same joint
(or of the bench) stands is folded under it as a consequence.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

FOLD: Final = 5.0  # [s] after a first cause within which related alarms are its consequences


class AlarmState(StrEnum):
    """Where an alarm is between its beginning and its end."""

    NORMAL = "normal"
    ACTIVE = "active"
    ACKNOWLEDGED = "acknowledged"
    RETURNED = "returned"
    LATCHED = "latched"


@dataclass(frozen=True)
class Alarm:
    """One alarm in SI: which check, where, how much, since when, what to do.

    `joint` is 1-based, None for the bench; `limit` is what was allowed; `time` [s] is the device's
    at the first offending sample `tick`; `value` is that sample's; `cause` is the key of the alarm
    that it follows from, empty for a first cause; `count` says how often it came while it stood.
    """

    check: str
    channel: str
    joint: int | None
    value: float
    limit: tuple[float, float]
    unit: str
    tick: int
    time: float
    sentence: str
    remedy: str
    trips: bool = False
    state: AlarmState = AlarmState.ACTIVE
    acknowledged: bool = False
    cause: str = ""
    count: int = 1

    @property
    def key(self) -> str:
        """What makes two occurrences the same alarm: its check and its channel or joint."""
        place = self.channel or (f"joint {self.joint}" if self.joint else "bench")
        return f"{self.check}: {place}"


@dataclass(frozen=True)
class AlarmTable:
    """The alarms that stand, in the order in which they began."""

    alarms: tuple[Alarm, ...] = field(default=())

    def get(self, key: str) -> Alarm | None:
        """Return the standing alarm of a key."""
        return next((alarm for alarm in self.alarms if alarm.key == key), None)

    @property
    def unacknowledged(self) -> tuple[Alarm, ...]:
        """The alarms that nobody has acknowledged."""
        return tuple(alarm for alarm in self.alarms if not alarm.acknowledged)


def _put(table: AlarmTable, alarm: Alarm) -> AlarmTable:
    """Replace the alarm of the same key; one that is normal leaves the table.

    Its consequences then stand for themselves: when it comes again it is no longer their cause.
    """
    if alarm.state is not AlarmState.NORMAL:
        return AlarmTable(tuple(alarm if old.key == alarm.key else old for old in table.alarms))
    kept = (old for old in table.alarms if old.key != alarm.key)
    return AlarmTable(
        tuple(replace(old, cause="") if old.cause == alarm.key else old for old in kept)
    )


def related(alarm: Alarm, other: Alarm) -> bool:
    """Say whether two alarms can have to do with each other: one joint, or one of the bench."""
    return alarm.joint is None or other.joint is None or alarm.joint == other.joint


def _first_cause(table: AlarmTable, alarm: Alarm) -> str:
    for earlier in table.alarms:
        recent = 0.0 <= alarm.time - earlier.time <= FOLD
        if not earlier.cause and recent and related(earlier, alarm):
            return earlier.key
    return ""


def raised(table: AlarmTable, alarm: Alarm) -> AlarmTable:
    """Return the table with an alarm that has begun, or has come again.

    One that comes again is active anew: an earlier acknowledgement no longer holds, unless it
    still stands. A trip takes the place of the warning of its own key.
    """
    state = AlarmState.LATCHED if alarm.trips else AlarmState.ACTIVE
    old = table.get(alarm.key)
    if old is None:
        new = replace(alarm, state=state, cause=_first_cause(table, alarm))
        return AlarmTable((*table.alarms, new))
    if old.state is AlarmState.LATCHED:
        return _put(table, replace(old, count=old.count + 1))
    if alarm.trips:
        return _put(table, replace(alarm, state=state, cause=old.cause, count=old.count))
    if old.state is AlarmState.RETURNED:
        return _put(table, replace(old, state=state, acknowledged=False, count=old.count + 1))
    return table


def returned(table: AlarmTable, key: str) -> AlarmTable:
    """Return the table after the value of an alarm has come back; a latched one stays."""
    old = table.get(key)
    if old is None or old.state not in (AlarmState.ACTIVE, AlarmState.ACKNOWLEDGED):
        return table
    state = AlarmState.NORMAL if old.acknowledged else AlarmState.RETURNED
    return _put(table, replace(old, state=state))


_AFTER_ACKNOWLEDGING: Final = {
    AlarmState.ACTIVE: AlarmState.ACKNOWLEDGED,
    AlarmState.RETURNED: AlarmState.NORMAL,
    AlarmState.LATCHED: AlarmState.LATCHED,
}


def acknowledged(table: AlarmTable, key: str | None = None) -> AlarmTable:
    """Return the table after a person has seen an alarm, or all of them (None).

    Raises KeyError for an alarm that does not stand.
    """
    keys = [alarm.key for alarm in table.alarms] if key is None else [key]
    for alarm_key in keys:
        old = table.get(alarm_key)
        if old is None:
            raise KeyError(f"no alarm {alarm_key!r} stands")
        state = _AFTER_ACKNOWLEDGING.get(old.state, old.state)
        table = _put(table, replace(old, state=state, acknowledged=True))
    return table


def folded(table: AlarmTable) -> tuple[tuple[Alarm, tuple[Alarm, ...]], ...]:
    """Return (first cause, its consequences) in the order of urgency.

    Above: what nobody has acknowledged, then what trips (or whose consequence does), then what is
    older. A consequence whose first cause is not in the table stands for itself.
    """
    standing = {alarm.key for alarm in table.alarms}
    groups = [
        (first, tuple(alarm for alarm in table.alarms if alarm.cause == first.key))
        for first in table.alarms
        if first.cause not in standing
    ]

    def urgency(group: tuple[Alarm, tuple[Alarm, ...]]) -> tuple[bool, bool, float]:
        every = (group[0], *group[1])
        seen = all(alarm.acknowledged for alarm in every)
        return seen, not any(alarm.trips for alarm in every), group[0].time

    return tuple(sorted(groups, key=urgency))
