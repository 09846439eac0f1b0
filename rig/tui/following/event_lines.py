"""Events as lines of the log: steps of the protocol, messages, alarms, losses, trips."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rig.bench.screens.display import LOST
from rig.bench.screens.sockets import Snapshot
from rig.tui.drawing.styles import ALARM_TEXT, DIM, PLAIN, STRONG, WARN_TEXT

KINDS: Final = ("all", "alarms", "protocol", "people")  # kinds that the log can be filtered by


@dataclass(frozen=True)
class EventLine:
    """One event at a time [s] since the run began; `kind` is one of KINDS."""

    time: float
    text: str
    style: str = PLAIN
    kind: str = "protocol"


EventText = tuple[str, str, str]  # text, style, kind
_ATTACHED: Final = "attached to run"
_OWN: Final = ("event", "time", "tick", "t", "parameters")  # fields of an event that are not shown


def new_lines(last: Snapshot | None, snapshot: Snapshot) -> list[EventLine]:
    """Return what is new in a snapshot compared with the previous one (None: a run's first)."""
    said: list[EventText] = []
    if last is not None and (last.run, last.pid) != (snapshot.run, snapshot.pid):
        last = None
    if last is None:
        said.append((f"{_ATTACHED} {snapshot.run} on {snapshot.rig}", STRONG, "people"))
    if last is None or _turn(snapshot) != _turn(last):
        text = _phase(snapshot.step, snapshot.phase, snapshot.message)
        said.append((text, PLAIN, "protocol"))
    elif snapshot.message not in (last.message, snapshot.trip):  # a trip has its own line
        said.append((snapshot.message, PLAIN, "protocol"))
    more = snapshot.lost_samples - (last.lost_samples if last else 0)
    if more > 0:
        text = f"{more} samples lost ({snapshot.lost_samples} in all)"
        said.append((text, ALARM_TEXT, "alarms"))
    said += _alarms(last, snapshot)
    said += _people(last, snapshot)
    if snapshot.device == LOST and (last is None or last.device != LOST):
        said.append(("DEVICE LOST", ALARM_TEXT, "alarms"))
    if snapshot.trip is not None and (last is None or last.trip != snapshot.trip):
        said.append((f"TRIP  {trip_text(snapshot.trip)}", ALARM_TEXT, "alarms"))
    if last is not None and snapshot.state != last.state:
        said.append((f"state: {last.state} → {snapshot.state}", STRONG, "protocol"))
    return [EventLine(snapshot.done_s, *parts) for parts in said if parts[0]]


def _alarms(last: Snapshot | None, snapshot: Snapshot) -> list[EventText]:
    before = {alarm.key: alarm for alarm in last.alarms} if last is not None else {}
    now = {alarm.key: alarm for alarm in snapshot.alarms}
    said: list[EventText] = []
    for key, alarm in now.items():
        old = before.get(key)
        if old is None and not alarm.trips:
            said.append((f"WARNING  {alarm.sentence}", WARN_TEXT, "alarms"))
        elif old is not None and old.state is not alarm.state:
            said.append((f"{key}: {old.state} → {alarm.state}", PLAIN, "alarms"))
    said += [(f"{key}: normal again", PLAIN, "alarms") for key in before if key not in now]
    return said


def _people(last: Snapshot | None, snapshot: Snapshot) -> list[EventText]:
    said: list[EventText] = []
    if snapshot.prompt and (last is None or last.prompt != snapshot.prompt):
        said.append((f"asked: {snapshot.prompt}", STRONG, "people"))
    if last is not None and snapshot.holder != last.holder:
        text = f"in command: {snapshot.holder}" if snapshot.holder else "nobody is in command"
        said.append((text, PLAIN, "people"))
    return said


def _turn(snapshot: Snapshot) -> tuple[str, str, int]:
    return snapshot.step, snapshot.phase, snapshot.repeat


def _phase(step: str, phase: str, message: str) -> str:
    """Return a phase of a step as one line, in a running log as in a stored one."""
    return f"{step} {phase}  {message}".strip()


def trip_text(trip: str) -> str:
    """Return a trip's message without its first words, which the screen shows larger."""
    return trip.removeprefix("safety trip: ")


def from_events(events: Iterable[Mapping[str, Any]], snapshot: Snapshot) -> list[EventLine]:
    """Return the lines of a run's event log, for a screen that attached late.

    Times come from the events' ticks: `snapshot` relates them to the run's beginning.
    """
    if not snapshot.device_time > 0 or not snapshot.tick:
        return []
    rate = snapshot.tick / snapshot.device_time
    lines = []
    for event in events:
        tick = event.get("tick")
        if not isinstance(tick, int):
            continue
        at = max(snapshot.done_s - (snapshot.tick - tick) / rate, 0.0)
        lines.append(EventLine(at, *event_text(event)))
    return lines


def with_earlier(lines: Sequence[EventLine], earlier: Sequence[EventLine]) -> tuple[EventLine, ...]:
    """Insert a run's event log where the screen attached to it; what both have stays once."""
    attached = [k for k, line in enumerate(lines) if line.text.startswith(_ATTACHED)]
    begin = attached[-1] if attached else 0
    known = {line.text for line in earlier}
    own = (line for line in lines[begin:] if line.text not in known)
    return (*lines[:begin], *earlier, *own)


def event_text(event: Mapping[str, Any]) -> EventText:
    """Return the line of an event; an event of an unknown kind is shown by its fields."""

    def get(key: str) -> str:
        return str(event.get(key, ""))

    texts: dict[str, EventText] = {
        "phase": (_phase(get("step"), get("phase"), get("message")), PLAIN, "protocol"),
        "state": (f"{get('before')} → {get('state')}: {get('why')}", DIM, "protocol"),
        "mark": (f"mark: {get('text')}", PLAIN, "protocol"),
        "alarm": (f"WARNING  {get('sentence')}", WARN_TEXT, "alarms"),
        "alarm returned": (f"{get('alarm')}: back within its band", PLAIN, "alarms"),
        "alarm acknowledged": (f"{get('alarm')}: acknowledged", PLAIN, "alarms"),
        "trip": (f"TRIP  {trip_text(get('message'))}", ALARM_TEXT, "alarms"),
        "samples lost": (f"{get('lost')} samples lost", ALARM_TEXT, "alarms"),
        "device lost": (f"DEVICE LOST  {get('message')}", ALARM_TEXT, "alarms"),
        "device back": ("the device is back", PLAIN, "alarms"),
        "answer": (f"answered {get('answer')!r} {get('by')}", PLAIN, "people"),
        "controls taken": (f"in command: {get('by')}", PLAIN, "people"),
        "controls released": (f"controls released by {get('by')}", PLAIN, "people"),
        "stop": (f"stop: {get('reason')}", STRONG, "people"),
    }
    fields = ", ".join(f"{key} {value}" for key, value in event.items() if key not in _OWN)
    other = (f"{event.get('event')}  {fields}".strip(), DIM, "protocol")
    return texts.get(get("event"), other)
