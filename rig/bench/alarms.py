"""The alarms of a session: violations found by the guard, in a table and as events of the run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

from rig.bench.checks.active_warnings import Key
from rig.bench.checks.catalogue import catalogue
from rig.model.alarms import states
from rig.model.alarms.states import Alarm, AlarmTable
from rig.model.rig import Rig
from rig.model.trips import Violation, describe

log = logging.getLogger(__name__)

# Fields of an alarm or a violation that every event has anyway: tick, time in the run, date.
_OF_EVENTS = frozenset({"tick", "time", "seconds"})

OnEvent = Callable[[str, int | None, Mapping[str, Any]], None]


def event_fields(source: Alarm | Violation) -> dict[str, Any]:
    """Return the data of an alarm or violation for an event, without `_OF_EVENTS`."""
    return {k: v for k, v in asdict(source).items() if k not in _OF_EVENTS}


class AlarmLog:
    """The table of a session's alarms; every change is one event."""

    def __init__(self, rig: Rig, on_event: OnEvent) -> None:
        """`on_event` takes the kind of change, its tick and the alarm's data."""
        self.table = AlarmTable()
        self._rig = rig
        self._on_event = on_event
        self._texts = {text.limit: text for text in catalogue()}
        self._active: dict[Key, str] = {}

    def alarm_of(self, violation: Violation, *, trips: bool) -> Alarm:
        """Return the alarm that a violation raises."""
        text = self._texts[violation.limit]
        return Alarm(
            check=violation.limit,
            channel=violation.channel,
            joint=violation.joint,
            value=violation.value,
            limit=violation.allowed,
            unit=violation.unit,
            tick=violation.tick,
            time=violation.tick / self._rig.sample_rate,
            sentence=f"{text.sentence} {describe(violation, self._rig)}",
            remedy=text.remedy,
            trips=trips,
        )

    def update(self, warnings: Mapping[Key, Violation], tick: int) -> None:
        """Update with the warnings active at a tick: raise new ones, end missing ones."""
        if not warnings and not self._active:
            return
        for key in self._active.keys() - warnings.keys():
            name = self._active.pop(key)
            self.table = states.returned(self.table, name)
            self._on_event("alarm returned", tick, {"alarm": name})
        for key, violation in warnings.items():
            if key not in self._active:
                self._active[key] = self._raise(self.alarm_of(violation, trips=False))

    def trip(self, violation: Violation) -> Alarm:
        """Raise and return the alarm of a trip, which latches."""
        alarm = self.alarm_of(violation, trips=True)
        self._raise(alarm)
        return alarm

    def _raise(self, alarm: Alarm) -> str:
        self.table = states.raised(self.table, alarm)
        stored = self.table.get(alarm.key) or alarm
        # The table keeps time and value of the first occurrence; the log has every occurrence.
        current = replace(
            alarm,
            state=stored.state,
            acknowledged=stored.acknowledged,
            cause=stored.cause,
            count=stored.count,
        )
        if not alarm.trips:
            log.warning("warning: %s", alarm.sentence)
        self._on_event("alarm", alarm.tick, {"alarm": alarm.key, **event_fields(current)})
        return alarm.key

    def acknowledge(self, key: str | None, tick: int) -> None:
        """Acknowledge an alarm, or all (None), for a person; an unknown key is logged."""
        keys = [alarm.key for alarm in self.table.unacknowledged]
        try:
            self.table = states.acknowledged(self.table, key)
        except KeyError as error:
            log.info("%s", error.args[0])
            return
        for key_of_alarm in keys if key is None else [key]:
            self._on_event("alarm acknowledged", tick, {"alarm": key_of_alarm})
