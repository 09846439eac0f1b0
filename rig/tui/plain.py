"""`bramah monitor --plain`: one line a second, for screen readers, logs and pipes.

Each line begins with the state in a word; events are separate lines, shown at once. After the end
of a run it is silent until the next one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from rig.model.parts import Wire
from rig.tui.following.event_lines import EventLine
from rig.tui.following.link import POLL, Frame, Link, LinkStage, LocalSessions
from rig.tui.units import age_text, shown
from rig.tui.words import headline, nearest_margin, notices, run_time, time_left

LINE_SECONDS: Final = 1.0  # [s]


def status_line(frame: Frame, now: float) -> str:
    """Return the state of the bench in one line."""
    head = headline(frame, now)
    snapshot = frame.snapshot
    if snapshot is None:
        return f"{head.word}: {_no_data_text(frame)}"
    parts = [f"{head.word}: {run_time(frame):.1f} s", f"{snapshot.step} {snapshot.phase}".strip()]
    if snapshot.repeats > 0:
        parts.append(f"repeat {snapshot.repeat} of {snapshot.repeats}")
    if snapshot.total_s > 0 and not frame.over:
        parts.append(f"{time_left(snapshot)} left")
    margin = nearest_margin(frame)
    if margin is not None:
        form = shown(margin.unit)
        parts.append(
            f"nearest limit {margin.channel} {form.number(margin.value)} of "
            f"{form.short(margin.limit)} {form.unit} ({margin.share:.0%})"
        )
    unacknowledged = sum(not alarm.acknowledged for alarm in snapshot.alarms)
    if snapshot.alarms:
        parts.append(f"{len(snapshot.alarms)} alarms, {unacknowledged} unacknowledged")
    parts.append(f"{snapshot.lost_samples} lost")
    if not frame.over:
        parts.append(f"age {age_text(frame.age(now))}")
    return ", ".join(part for part in parts if part)


def _no_data_text(frame: Frame) -> str:
    if frame.trouble:
        return f"cannot reach runs: {frame.trouble}"
    if frame.stage is LinkStage.CHOOSING:
        names = ", ".join(f"{e.rig} (process {e.pid})" for e in frame.sessions)
        return f"several runs, name one with --rig, or its bench with --endpoint: {names}"
    return "waiting for a run" if frame.endpoint is None else "attached, nothing received yet"


class Reader:
    """Prints changes: status lines every second, and events as they are received."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._printed: tuple[EventLine, ...] = ()
        self._next = -float("inf")
        self._last = ""

    def read(self, frame: Frame, now: float) -> None:
        """Print what is new in a frame."""
        printed = set(map(id, self._printed))
        for event_line in frame.event_lines:
            if id(event_line) not in printed:
                self._say(f"  at {event_line.time:.2f} s: {event_line.text}")
        self._printed = frame.event_lines
        quiet = frame.over or frame.snapshot is None
        line = status_line(frame, now)
        if quiet and line != self._last:
            self._say(line)
            for notice in notices(frame, None, now, paused=False):
                self._say(f"  {notice.text}")
        elif not quiet and now >= self._next:
            self._next = now + LINE_SECONDS
            self._say(line)
        self._last = line


def print_status(rig: str | None, say: Callable[[str], None], wire: Wire | None = None) -> None:
    """Print a run's status and events until interrupted; the run is not commanded.

    Of several runs of a rig it is that at `wire`.
    """
    link = Link(LocalSessions(rig, wire), time.monotonic)
    reader = Reader(say)
    link.start()
    try:
        while True:
            reader.read(link.frame, time.monotonic())
            time.sleep(POLL)
    finally:
        link.close()
