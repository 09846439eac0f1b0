"""Items of a queue, their states, and their conditions to start. No I/O.

Glossary: an *item* is one protocol on one bench into one run folder; an *attempt* is one start of
it; an item *waits* while it may start later, and is *over* in a final state.
"""

from __future__ import annotations

import operator
import re
import unicodedata
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from typing import Any, Final

from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.quantity import UnitError, to_si

QUEUED: Final = "queued"
CHECKING: Final = "checking"
RUNNING: Final = "running"
DONE: Final = "done"
FAILED: Final = "failed"
REFUSED: Final = "refused"
TRIPPED: Final = "tripped"
LOST: Final = "device lost"
STOPPED: Final = "stopped"
INTERRUPTED: Final = "interrupted"
CANCELLED: Final = "cancelled"
SKIPPED: Final = "skipped"
EXPIRED: Final = "expired"

ACTIVE: Final = (CHECKING, RUNNING)
OVER: Final = {
    DONE: "ran to its end",
    FAILED: "failed; see the reason",
    REFUSED: "refused at its start, by the check of its input or of its limits on the twin",
    TRIPPED: "a safety limit was passed; the queue stopped",
    LOST: "the device no longer answered",
    STOPPED: "stopped by a person, or with the runner",
    INTERRUPTED: "its process was killed; what it recorded was recovered",
    CANCELLED: "cancelled by a person",
    SKIPPED: "the item of --after did not end as --if states",
    EXPIRED: "its start condition was not met before its latest start",
}
STATES: Final = (QUEUED, *ACTIVE, *OVER)
ENDED: Final = "ended"  # as a condition: any final state

_COMPARISONS: Final[dict[str, Callable[[float, float], bool]]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION = re.compile(
    r"^\s*(?P<name>[A-Za-z][A-Za-z0-9_]*)(?:\.(?P<part>value|std|rsd))?\s*"
    r"(?P<sign><=|>=|<|>)\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*?)\s*$"
)


@dataclass(frozen=True)
class StartCondition:
    """A comparison of a channel's mean, or of an identified parameter, with a number in SI.

    `part` is '' for a channel; value, std or rsd (standard error over value) for a parameter.
    """

    name: str
    part: str
    sign: str
    bound: float

    def holds(self, value: float) -> bool:
        """Return whether a value in SI fulfils the comparison; NaN never does."""
        return _COMPARISONS[self.sign](value, self.bound)


def _split(text: str, option: str, example: str) -> re.Match[str]:
    match = _CONDITION.match(text)
    if match is None:
        raise InputError(f"{option} {text!r}: expected NAME, one of < <= > >=, a number: {example}")
    return match


def channel_condition(
    text: str, measured: Mapping[str, tuple[float, float]] | None = None
) -> StartCondition:
    """Read ``oil_temperature > 40 degC``; raises InputError for an unknown channel or unit.

    With `measured`, the readable range of each channel of a bench, also for a channel that it does
    not measure and a bound that no reading can pass.
    """
    parts = _split(text, "--when", "'oil_temperature > 40 degC'")
    name = parts["name"]
    try:
        unit = ch.unit_of(name)
        if parts["part"]:
            raise ValueError(f"{name}.{parts['part']}: a channel has no parts")
        if unit and not parts["unit"]:
            raise UnitError(f"{parts['number']} has no unit; expected one like '1 {unit}'")
        bound = to_si(float(parts["number"]), parts["unit"], unit)
    except ValueError as error:
        raise InputError(f"--when {text!r}: {error}") from error
    if measured is not None and name not in measured:
        raise InputError(
            f"--when {text!r}: the bench does not measure {name}; expected one of: "
            f"{' '.join(measured)}"
        )
    condition = StartCondition(name, "", parts["sign"], bound)
    if measured is not None and not any(map(condition.holds, measured[name])):
        low, high = measured[name]
        raise InputError(
            f"--when {text!r}: no reading fulfils it; expected a bound within the sensor's range, "
            f"{low:g} to {high:g} {unit}"
        )
    return condition


def result_condition(text: str) -> StartCondition:
    """Read ``b.rsd < 0.5 %`` or ``M1 > 2`` (SI); raises InputError."""
    parts = _split(text, "--if", "'b.rsd < 0.5 %'")
    part = parts["part"] or "value"
    if part != "rsd" and parts["unit"]:
        raise InputError(
            f"--if {text!r}: a parameter is compared in SI, without a unit; its relative standard "
            f"error, {parts['name']}.rsd, may have %"
        )
    if parts["unit"] not in ("", "%"):
        raise InputError(f"--if {text!r}: the unit is {parts['unit']!r}; expected % or none")
    scale = 0.01 if parts["unit"] else 1.0
    return StartCondition(parts["name"], part, parts["sign"], scale * float(parts["number"]))


def check_wanted(text: str, known: Collection[str]) -> None:
    """Raise InputError unless `text` is a final state, ``ended``, or a condition on a result.

    `known` are the names of the parameters that are identified from the item waited for.
    """
    if text == ENDED or text in OVER:
        return
    if re.fullmatch(r"[a-z ]+", text):
        raise InputError(f"--if {text!r}: expected one of: {', '.join((ENDED, *OVER))}")
    name = _split(text, "--if", "'b.rsd < 0.5 %'")["name"]
    if name not in known:
        raise InputError(
            f"--if {text!r}: {name!r} is no parameter of that item's rig; expected one of: "
            f"{' '.join(known)}"
        )
    result_condition(text)


def parse_time(text: str, now: datetime, option: str) -> datetime:
    """Read a time of day (the next 22:30, this computer's zone) or ISO 8601; raises InputError."""
    try:
        clock = datetime.strptime(text, "%H:%M").time()
    except ValueError:
        try:
            return datetime.fromisoformat(text).astimezone(UTC)
        except ValueError:
            raise InputError(
                f"{option} {text!r}: expected a time such as 22:30 or 2026-03-01T22:30"
            ) from None
    local = now.astimezone()
    moment = local.replace(hour=clock.hour, minute=clock.minute, second=0, microsecond=0)
    if moment < local.replace(second=0, microsecond=0):
        # In local time, since a day with a change of the clocks does not last 24 h.
        day = moment.date().toordinal() + 1
        naive = datetime.combine(datetime.fromordinal(day).date(), clock)
        moment = naive.astimezone()
    return moment.astimezone(UTC)


def require_one_line(text: str, option: str) -> None:
    """Raise InputError for a name with a line break or another control character."""
    if any(unicodedata.category(letter) in ("Cc", "Zl", "Zp") for letter in text):
        raise InputError(
            f"{option} {text!r}: found a line break or another control character; expected a name "
            "of one line"
        )


@dataclass(frozen=True)
class QueueJob:
    """The user's request; times are ISO 8601 in UTC, paths absolute, '' if not given.

    `options` are arguments of both `bramah check` and `bramah run`, `run_options` of `run` only.
    `after` is an item's number, `wanted` the condition on its result.
    """

    protocol: str
    rig: str
    out: str
    name: str
    endpoint: str = ""
    options: tuple[str, ...] = ()
    run_options: tuple[str, ...] = ()
    not_before: str = ""
    not_after: str = ""
    after: int | None = None
    wanted: str = DONE
    when: str = ""
    identify: bool = True

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> QueueJob:
        """Return a job from plain data; keys of later versions are ignored."""
        names = {f.name for f in fields(cls)}
        values = {key: value for key, value in data.items() if key in names}
        for name in ("options", "run_options"):
            values[name] = tuple(values.get(name, ()))
        return cls(**values)

    def check_words(self) -> list[str]:
        """Return the arguments of the proof on the twin, with JSON on standard output."""
        return ["check", self.protocol, "--rig", self.rig, *self.options, "--json", "-"]

    @property
    def bench_words(self) -> list[str]:
        """The arguments that name the bench."""
        return ["--rig", self.rig, *(["--endpoint", self.endpoint] if self.endpoint else [])]

    def run_words(self, folder: str) -> list[str]:
        """Return the arguments of the run into `folder`."""
        line = ["run", self.protocol, *self.bench_words, "--out", folder]
        return [*line, *self.options, *self.run_options]


@dataclass(frozen=True)
class Item:
    """An item of the queue with its present state.

    `priority`: higher starts first; `place` orders equal ones. `run` is the folder of the latest
    attempt, `proof` the proof when queued, `results` the parameters identified from the run.
    """

    id: int
    priority: int
    place: float
    state: str
    reason: str
    job: QueueJob
    attempt: int = 0
    run: str = ""
    pid: int | None = None
    cancel: bool = False
    added: str = ""
    started: str = ""
    ended: str = ""
    proof: dict[str, Any] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)

    @property
    def over(self) -> bool:
        """Whether the item is in a final state."""
        return self.state in OVER

    def as_dict(self) -> dict[str, Any]:
        """Return the item as plain data for JSON."""
        data = asdict(self)
        return {**data, "found": data.pop("results")}

    def next_folder(self) -> str:
        """Return the run folder of the next attempt; a number is appended from the second on."""
        return self.job.out if self.attempt == 0 else f"{self.job.out}-{self.attempt + 1}"


def result_value(results: Mapping[str, Any], condition: StartCondition) -> float | None:
    """Return the part of an identified parameter that a condition compares, None if unknown."""
    entry = results.get("parameters", {}).get(condition.name)
    if not entry or entry.get("value") is None:
        return None
    value, std = float(entry["value"]), entry.get("std")
    if condition.part == "value":
        return value
    if std is None:
        return None
    return float(std) if condition.part == "std" else (abs(float(std) / value) if value else None)
