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
_NOT_SHOWN: Final = ("event", "time", "tick", "t", "parameters")  # fields of an event


def new_lines(last: Snapshot | None, snapshot: Snapshot) -> list[EventLine]:
    """Return what is new in a snapshot compared with the previous one (None: a run's first)."""
    texts: list[EventText] = []
    if last is not None and (last.run, last.pid) != (snapshot.run, snapshot.pid):
        last = None
    if last is None:
        texts.append((f"{_ATTACHED} {snapshot.run} on {snapshot.rig}", STRONG, "people"))
    if last is None or _part_of_run(snapshot) != _part_of_run(last):
        text = _phase(snapshot.step, snapshot.phase, snapshot.message)
        texts.append((text, PLAIN, "protocol"))
    elif snapshot.message not in (last.message, snapshot.trip):  # a trip has its own line
        texts.append((snapshot.message, PLAIN, "protocol"))
    newly_lost = snapshot.lost_samples - (last.lost_samples if last else 0)
    if newly_lost > 0:
        text = f"{newly_lost} samples lost ({snapshot.lost_samples} in all)"
        texts.append((text, ALARM_TEXT, "alarms"))
    texts += _alarms(last, snapshot)
    texts += _people(last, snapshot)
    if snapshot.device == LOST and (last is None or last.device != LOST):
        texts.append(("DEVICE LOST", ALARM_TEXT, "alarms"))
    if snapshot.trip is not None and (last is None or last.trip != snapshot.trip):
        texts.append((f"TRIP  {trip_text(snapshot.trip)}", ALARM_TEXT, "alarms"))
    if last is not None and snapshot.state != last.state:
        texts.append((f"state: {last.state} → {snapshot.state}", STRONG, "protocol"))
    return [EventLine(snapshot.done_s, *parts) for parts in texts if parts[0]]


def _alarms(last: Snapshot | None, snapshot: Snapshot) -> list[EventText]:
    before = {alarm.key: alarm for alarm in last.alarms} if last is not None else {}
    present = {alarm.key: alarm for alarm in snapshot.alarms}
    texts: list[EventText] = []
    for key, alarm in present.items():
        old = before.get(key)
        if old is None and not alarm.trips:
            texts.append((f"WARNING  {alarm.sentence}", WARN_TEXT, "alarms"))
        elif old is not None and old.state is not alarm.state:
            texts.append((f"{key}: {old.state} → {alarm.state}", PLAIN, "alarms"))
    texts += [(f"{key}: normal again", PLAIN, "alarms") for key in before if key not in present]
    return texts


def _people(last: Snapshot | None, snapshot: Snapshot) -> list[EventText]:
    texts: list[EventText] = []
    if snapshot.prompt and (last is None or last.prompt != snapshot.prompt):
        texts.append((f"asked: {snapshot.prompt}", STRONG, "people"))
    if last is not None and snapshot.holder != last.holder:
        text = f"in command: {snapshot.holder}" if snapshot.holder else "nobody is in command"
        texts.append((text, PLAIN, "people"))
    return texts


def _part_of_run(snapshot: Snapshot) -> tuple[str, str, int]:
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
    """Insert a run's event log where the screen attached to it, without repeating its lines."""
    attached = [k for k, line in enumerate(lines) if line.text.startswith(_ATTACHED)]
    attached_at = attached[-1] if attached else 0
    earlier_texts = {line.text for line in earlier}
    further = (line for line in lines[attached_at:] if line.text not in earlier_texts)
    return (*lines[:attached_at], *earlier, *further)


def event_text(event: Mapping[str, Any]) -> EventText:
    """Return the line of an event; an event of an unknown kind is shown by its fields."""

    def field(key: str) -> str:
        return str(event.get(key, ""))

    texts: dict[str, EventText] = {
        "phase": (_phase(field("step"), field("phase"), field("message")), PLAIN, "protocol"),
        "state": (f"{field('before')} → {field('state')}: {field('why')}", DIM, "protocol"),
        "mark": (f"mark: {field('text')}", PLAIN, "protocol"),
        "alarm": (f"WARNING  {field('sentence')}", WARN_TEXT, "alarms"),
        "alarm returned": (f"{field('alarm')}: back within its band", PLAIN, "alarms"),
        "alarm acknowledged": (f"{field('alarm')}: acknowledged", PLAIN, "alarms"),
        "trip": (f"TRIP  {trip_text(field('message'))}", ALARM_TEXT, "alarms"),
        "samples lost": (f"{field('lost')} samples lost", ALARM_TEXT, "alarms"),
        "device lost": (f"DEVICE LOST  {field('message')}", ALARM_TEXT, "alarms"),
        "device back": ("the device is back", PLAIN, "alarms"),
        "answer": (f"answered {field('answer')!r} {field('by')}", PLAIN, "people"),
        "controls taken": (f"in command: {field('by')}", PLAIN, "people"),
        "controls released": (f"controls released by {field('by')}", PLAIN, "people"),
        "stop": (f"stop: {field('reason')}", STRONG, "people"),
    }
    fields = ", ".join(f"{key} {value}" for key, value in event.items() if key not in _NOT_SHOWN)
    other = (f"{event.get('event')}  {fields}".strip(), DIM, "protocol")
    return texts.get(field("event"), other)
