"""The log of a run that has ended, read from its folder for the screen."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rig.runs.runstate import EVENTS
from rig.tui.following.event_lines import EventLine, event_text

MOST: Final = 20_000  # newest lines that are kept
LONGEST: Final = 400  # characters of a line


@dataclass(frozen=True)
class RunLog:
    """The lines of a run's log, oldest first; `trouble` is one line about damage."""

    folder: Path
    lines: tuple[EventLine, ...] = ()
    trouble: str = ""
    reading: bool = False


def read_log(folder: Path) -> RunLog:
    """Read the events of a run; never raises: `trouble` states what cannot be read."""
    path = folder / EVENTS
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        return RunLog(folder, trouble=f"{path}: there is no such file, so the run has no log")
    except OSError as error:
        return RunLog(folder, trouble=f"{path}: cannot be read: {error.strerror}")
    entries: list[EventLine] = []
    bad: list[int] = []
    newest = 0.0
    lines = raw.splitlines()
    for number, line in enumerate(lines, 1):
        event = _event(line)
        if event is None:
            bad.append(number)
            continue
        newest = _time(event, newest)
        text, style, kind = event_text(event)
        entries.append(EventLine(newest, _printable(text), style, kind))
    torn = bad == [len(lines)] and not raw.endswith(b"\n")
    return RunLog(folder, tuple(entries[-MOST:]), _trouble(path, bad, len(lines), torn=torn))


def _event(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) and "event" in entry else None


def _time(event: dict[str, Any], before: float) -> float:
    """Return an event's time [s since the run began]; the previous one's where it has none."""
    at = event.get("t")
    known = isinstance(at, int | float) and not isinstance(at, bool) and math.isfinite(at)
    return float(at) if known and at is not None else before


def _printable(text: str) -> str:
    """Return a text without control characters, which a damaged file may hold."""
    flat = " ".join(text.split())
    return "".join(c if c.isprintable() else "·" for c in flat[:LONGEST])


def _trouble(path: Path, bad: list[int], count: int, *, torn: bool) -> str:
    if torn:
        return f"{path}: the last line was cut off, as by a kill; the lines before it are shown"
    if bad:
        return (
            f"{path}: {len(bad)} of {count} lines cannot be read, the first is line {bad[0]}; "
            "expected one JSON object with 'event' a line"
        )
    return "" if count else f"{path}: is empty"
