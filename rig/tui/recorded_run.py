"""The log and the stored trace of a run that has ended, read from its folder for the screen."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from rig.model.channels import place_in_words
from rig.runs.runstate import EVENTS
from rig.tui.following.event_lines import EventLine, event_text

STORED: Final = "trace.json"  # the output of `bramah trace --json`, in the run's folder or above it

Numbers = Mapping[str, float | None]

MOST_LINES: Final = 20_000  # newest lines that are kept
LONGEST_LINE: Final = 400  # characters of a line


class _Stored(BaseModel):
    """A part of the JSON of a trace; keys that the screen does not show are left out."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class StoredEstimate(_Stored):
    """A parameter: value, unit, 95 % interval."""

    value: float | None
    unit: str = ""
    ci95: tuple[float | None, float | None] = (None, None)


class StoredGate(_Stored):
    """One condition for a name."""

    name: str
    ok: bool
    detail: str = ""


class StoredEffect(_Stored):
    """An effect with its place."""

    name: str
    where: str
    at: str = ""
    parameters: Mapping[str, StoredEstimate] = {}
    removed_fraction: float | None = None
    gates: tuple[StoredGate, ...] = ()

    @property
    def location(self) -> str:
        """Its place in words, with the sensor of a joint."""
        return place_in_words(self.at or self.where)


class StoredErrors(_Stored):
    """Held-out rms of every equation, SI."""

    noise_floor: Numbers
    before: Numbers
    after: Numbers


class StoredPair(_Stored):
    """A number by channel, before and after."""

    before: Numbers = {}
    after: Numbers = {}


class StoredCurves(_Stored):
    """A channel of a free run, SI."""

    unit: str
    measured: tuple[float | None, ...]
    before: tuple[float | None, ...]
    after: tuple[float | None, ...]


class StoredFreeRun(_Stored):
    """The beginning of a held-out record, measured and simulated."""

    record: str
    time: tuple[float, ...]
    channels: Mapping[str, StoredCurves]


class StoredNext(_Stored):
    """The next experiment."""

    text: str = ""


class StoredTrace(_Stored):
    """The parts of a trace's JSON that the screen shows."""

    verdict: str
    sentence: str = ""
    effects: tuple[StoredEffect, ...] = ()
    refused: tuple[StoredEffect, ...] = ()
    error: StoredErrors
    fit: StoredPair = StoredPair()
    free_run: StoredFreeRun | None = None
    next_experiment: StoredNext | None = None
    notes: tuple[str, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the model after differs: a clean bench keeps the model that it had."""
        pairs = ((self.error.before, self.error.after), (self.fit.before, self.fit.after))
        return any(before != after for before, after in pairs)


@dataclass(frozen=True)
class RunTrace:
    """The trace of a run's folder; `trouble` is one line on why there is none."""

    folder: Path
    path: Path | None = None
    stored: StoredTrace | None = None
    trouble: str = ""
    reading: bool = False


def read_trace(folder: Path) -> RunTrace:
    """Read the trace stored in a run's folder, else next to it; never raises."""
    candidates = (folder / STORED, folder.parent / STORED)
    path = next((place for place in candidates if place.is_file()), None)
    if path is None:
        hint = "`trace what its model lacks` on the page of runs writes it"
        return RunTrace(folder, trouble=f"{candidates[0]}: there is no such file; {hint}")
    try:
        return RunTrace(folder, path, StoredTrace.model_validate_json(path.read_bytes()))
    except OSError as error:
        return RunTrace(folder, path, trouble=f"{path}: cannot be read: {error.strerror}")
    except ValidationError as error:
        return RunTrace(folder, path, trouble=f"{path}: {_first_error_text(error)}")


def _first_error_text(error: ValidationError) -> str:
    """Return the first error with its key; `bramah trace --json` is expected."""
    problem = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "json_invalid":
        return f"is not JSON ({problem['msg']}); expected the output of `bramah trace --json`"
    name = str(problem["input"])[:40]
    return f"{key}: {problem['msg']}, found {name}; expected the output of `bramah trace --json`"


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
    damaged: list[int] = []
    newest = 0.0
    lines = raw.splitlines()
    for number, line in enumerate(lines, 1):
        event = _event(line)
        if event is None:
            damaged.append(number)
            continue
        newest = _time(event, newest)
        text, style, kind = event_text(event)
        entries.append(EventLine(newest, _printable(text), style, kind))
    cut_off = damaged == [len(lines)] and not raw.endswith(b"\n")
    trouble = _trouble(path, damaged, len(lines), cut_off=cut_off)
    return RunLog(folder, tuple(entries[-MOST_LINES:]), trouble)


def _event(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) and "event" in entry else None


def _time(event: dict[str, Any], before: float) -> float:
    """Return an event's time [s since the run began]; the previous one's where it has none."""
    at = event.get("t")
    if isinstance(at, int | float) and not isinstance(at, bool) and math.isfinite(at):
        return float(at)
    return before


def _printable(text: str) -> str:
    """Return a text without control characters, which a damaged file may hold."""
    flat = " ".join(text.split())
    return "".join(c if c.isprintable() else "·" for c in flat[:LONGEST_LINE])


def _trouble(path: Path, damaged: list[int], count: int, *, cut_off: bool) -> str:
    if cut_off:
        return f"{path}: the last line was cut off, as by a kill; the lines before it are shown"
    if damaged:
        return (
            f"{path}: {len(damaged)} of {count} lines cannot be read, the first is line "
            f"{damaged[0]}; expected one JSON object with 'event' a line"
        )
    return "" if count else f"{path}: is empty"
