"""Snapshots of a run for screens, about twenty per second, and its last minute for late ones.

A snapshot is immutable and min/max-decimated. Of each, the run keeps one bucket: the smallest and
the largest sample of every channel. The answer to the command "past" is a JSON header and a float64
array (buckets, 1 + 2 channels): device time [s], smallest samples, largest samples [SI].
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.model.alarms.states import Alarm, AlarmState

Array = NDArray[np.float64]
Band = tuple[float | None, float | None]

BUCKETS = 25  # per snapshot; at 20 snapshots per second, 500 columns of a plot

KEPT: Final = 1200  # buckets: one minute of wall time at twenty snapshots a second


@dataclass(frozen=True)
class ChannelView:
    """One channel since the previous snapshot, in SI; `low` and `high` are its limits.

    Values below `warn_low` or above `warn_high` cause a warning.
    """

    unit: str
    low: float | None
    high: float | None
    last: float
    minimum: list[float] = field(default_factory=list)
    maximum: list[float] = field(default_factory=list)
    warn_low: float | None = None
    warn_high: float | None = None


@dataclass(frozen=True)
class Progress:
    """The progress of the protocol, from the engine to the screen.

    `engine` is the state of the protocol's engine; `prompt` the open question, with its possible
    `answers`. `part` of `parts` (from 1) is the step of the plan; `estimates` holds [value, low,
    high] in SI by parameter, low to high being its 95 % interval; `residuals` holds [rms, size] in
    SI by family of equations: rms of the prediction error of the newest rows, and of those rows.
    `device` is empty, or "lost".
    """

    step: str = ""
    phase: str = ""
    repeat: int = 0
    repeats: int = 0
    done_s: float = 0.0
    total_s: float = 0.0
    message: str = ""
    engine: str = ""
    prompt: str = ""
    answers: list[str] = field(default_factory=list)
    kind: str = "protocol"
    part: int = 0
    parts: int = 0
    device: str = ""
    estimates: dict[str, list[float | None]] = field(default_factory=dict)
    residuals: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class BenchView:
    """The bench's part of a snapshot.

    `state` is running, tripped, done or aborted; `device_time` and `wall_time` are in seconds
    (the latter since the epoch); `block_age` [s] is the lateness of the newest block. `alarms` are
    the active ones (`rig.model.alarms.states.folded` orders them). `wire` is its endpoint. `holder`
    is the screen in control, `roles` the role of each joint (excited, free, locked).
    """

    run: str
    rig: str
    state: str
    tick: int
    device_time: float
    wall_time: float
    block_age: float
    lost_samples: int
    trip: str | None
    alarms: tuple[Alarm, ...] = ()
    holder: str = ""
    roles: list[str] = field(default_factory=list)
    wire: str = ""
    sample_rate: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Snapshot(Progress, BenchView):
    """The run at one moment, of the process `pid`."""

    pid: int
    channels: dict[str, ChannelView]


def decimate(samples: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """Return (minimum, maximum) of at most `buckets` slices of (n, channels) samples."""
    n = len(samples)
    if n == 0:
        return samples, samples
    edges = np.unique(np.linspace(0, n, min(n, buckets) + 1).astype(int)[:-1])
    return np.minimum.reduceat(samples, edges), np.maximum.reduceat(samples, edges)


def take_snapshot(
    view: BenchView,
    progress: Progress,
    samples: Array,
    units: Mapping[str, str],
    limits: Mapping[str, Band],
    warnings: Mapping[str, Band] | None = None,
) -> Snapshot:
    """Return a snapshot of the samples (n, channels) since the previous one; n may be 0.

    `limits` and, if known, `warnings` are the bands of every channel.
    """
    low, high = decimate(samples)
    channels = {}
    for column, (name, unit) in enumerate(units.items()):
        last = float(samples[-1, column]) if len(samples) else float("nan")
        near = (None, None) if warnings is None else warnings.get(name, (None, None))
        channels[name] = ChannelView(
            unit, *limits[name], last, low[:, column].tolist(), high[:, column].tolist(), *near
        )
    return Snapshot(pid=os.getpid(), channels=channels, **vars(view), **vars(progress))


def _alarm(view: dict[str, Any]) -> Alarm:
    low, high = view.pop("limit")
    return Alarm(**{**view, "limit": (low, high), "state": AlarmState(view["state"])})


def to_json(snapshot: Snapshot) -> bytes:
    """Write a snapshot as JSON."""
    # `asdict` copies every number, which would take three times as long as the rest.
    data = dict(vars(snapshot))
    data["channels"] = {name: vars(view) for name, view in snapshot.channels.items()}
    data["alarms"] = [asdict(alarm) for alarm in snapshot.alarms]
    return json.dumps(data).encode()


def from_json(raw: bytes) -> Snapshot:
    """Read a snapshot; raises ValueError for anything else."""
    try:
        data: dict[str, Any] = json.loads(raw)
        channels = {name: ChannelView(**view) for name, view in data.pop("channels").items()}
        alarms = tuple(_alarm(view) for view in data.pop("alarms", ()))
        return Snapshot(**data, channels=channels, alarms=alarms)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a snapshot: {error}") from error


@dataclass(frozen=True)
class PlanLine:
    """One step of the plan for a screen: name, description, expected time [s]."""

    name: str
    title: str
    seconds: float


@dataclass(frozen=True)
class PastMinute:
    """The last minute of a run: ends (n,) of the buckets [s of device time], their low and high."""

    names: tuple[str, ...]
    time: Array
    low: Array
    high: Array
    plan: tuple[PlanLine, ...] = ()


class PastKeeper:
    """Keeps the newest buckets of a run."""

    def __init__(self, names: Sequence[str]) -> None:
        self.plan: tuple[PlanLine, ...] = ()
        self._names = tuple(names)
        self._rows: deque[Array] = deque(maxlen=KEPT)

    def add(self, device_time: float, samples: Array) -> None:
        """Add the samples (n, channels) of a snapshot as one bucket; n = 0 adds none."""
        if len(samples):
            low, high = np.minimum.reduce(samples, axis=0), np.maximum.reduce(samples, axis=0)
            parts = ([device_time], low, high)
            self._rows.append(np.concatenate(parts))

    def answer(self) -> tuple[dict[str, Any], bytes]:
        """Return the header and the bytes of the array."""
        width = 1 + 2 * len(self._names)
        table = np.array(self._rows) if self._rows else np.empty((0, width))
        header = {"names": self._names, "plan": [asdict(line) for line in self.plan]}
        return header, np.ascontiguousarray(table, dtype="<f8").tobytes()


def past_from(header: Mapping[str, Any], raw: bytes) -> PastMinute:
    """Read an answer; raises ValueError for anything else."""
    try:
        names = tuple(map(str, header["names"]))
        table = np.frombuffer(raw, dtype="<f8").reshape(-1, 1 + 2 * len(names))
        plan = tuple(PlanLine(**line) for line in header["plan"])
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a valid answer to the command past: {error}") from error
    middle = 1 + len(names)
    return PastMinute(names, table[:, 0], table[:, 1:middle], table[:, middle:], plan)
