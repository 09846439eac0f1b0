"""Alarms in operation: states, first cause and consequences; data and functions.

The states are those of ISA-18.2 (2016, 5.6): an alarm is *active* until somebody acknowledges it
(*acknowledged*) or the value comes back (*returned*); both together make it *normal* again, and it
leaves the table. A trip is *latched*: it stays until it is reset with a reason, and it can be reset
only after it was acknowledged. Acknowledging means "I have seen it"; resetting means "its cause is
removed". An alarm that begins while an earlier one of the same joint (or of the bench) is in the
table is shown under it as a consequence.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

FOLD: Final = 5.0  # [s] after a first cause within which related alarms are its consequences


class AlarmState(StrEnum):
    """State of an alarm between its beginning and its end."""

    NORMAL = "normal"
    ACTIVE = "active"
    ACKNOWLEDGED = "acknowledged"
    RETURNED = "returned"
    LATCHED = "latched"


@dataclass(frozen=True)
class Alarm:
    """One alarm in SI: check, place, value, start, remedy.

    `joint` is 1-based, None for the bench; `limit` is the allowed range; `time` [s] is the device's
    at the first offending sample `tick`, `value` that sample's; `cause` is the key of the alarm
    that it follows from, empty for a first cause; `count` is the number of its occurrences while in
    the table.
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
        """Identity of an alarm over its occurrences: its check and its channel or joint."""
        place = self.channel or (f"joint {self.joint}" if self.joint else "bench")
        return f"{self.check}: {place}"


@dataclass(frozen=True)
class AlarmTable:
    """The present alarms, in the order in which they began."""

    alarms: tuple[Alarm, ...] = field(default=())

    def get(self, key: str) -> Alarm | None:
        """Return the alarm of a key, None if it is not in the table."""
        return next((alarm for alarm in self.alarms if alarm.key == key), None)

    @property
    def unacknowledged(self) -> tuple[Alarm, ...]:
        """The alarms that nobody has acknowledged."""
        return tuple(alarm for alarm in self.alarms if not alarm.acknowledged)


def _put(table: AlarmTable, alarm: Alarm) -> AlarmTable:
    """Replace the alarm of the same key; one that is normal leaves the table.

    Its consequences then become first causes: a later occurrence is no longer their cause.
    """
    if alarm.state is not AlarmState.NORMAL:
        return AlarmTable(tuple(alarm if old.key == alarm.key else old for old in table.alarms))
    kept = (old for old in table.alarms if old.key != alarm.key)
    return AlarmTable(
        tuple(replace(old, cause="") if old.cause == alarm.key else old for old in kept)
    )


def related(alarm: Alarm, other: Alarm) -> bool:
    """Return whether two alarms may be related: of one joint, or one of them of the bench."""
    return alarm.joint is None or other.joint is None or alarm.joint == other.joint


def _first_cause(table: AlarmTable, alarm: Alarm) -> str:
    for earlier in table.alarms:
        recent = 0.0 <= alarm.time - earlier.time <= FOLD
        if not earlier.cause and recent and related(earlier, alarm):
            return earlier.key
    return ""


def raised(table: AlarmTable, alarm: Alarm) -> AlarmTable:
    """Return the table with an alarm that has begun or recurred.

    A recurring alarm is active again and needs a new acknowledgement, unless it was still present.
    A trip replaces the warning of its key.
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
    """Return the table after the value of an alarm has come back; a latched alarm stays."""
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
    """Return the table after a person has acknowledged an alarm, or all of them (None).

    Raises KeyError for an alarm that is not in the table.
    """
    keys = [alarm.key for alarm in table.alarms] if key is None else [key]
    for alarm_key in keys:
        old = table.get(alarm_key)
        if old is None:
            raise KeyError(f"there is no alarm {alarm_key!r}")
        state = _AFTER_ACKNOWLEDGING.get(old.state, old.state)
        table = _put(table, replace(old, state=state, acknowledged=True))
    return table


def folded(table: AlarmTable) -> tuple[tuple[Alarm, tuple[Alarm, ...]], ...]:
    """Return (first cause, its consequences) in the order of urgency.

    First unacknowledged alarms, then those that trip (or whose consequence does), then older ones.
    A consequence whose first cause is not in the table is listed as a first cause.
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
