"""The data of a run: one record per step and repeat."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.model.parse import InputError
from rig.model.rig import Rig

Array = NDArray[np.float64]

BANDWIDTH: Final = "bandwidth"  # attribute of a record: below it is the motion [Hz]
LOADED: Final = "loaded"  # attribute of a record: 1 with a load on the last link, 0 without


def stated_load(attributes: Mapping[str, str | float | int]) -> bool | None:
    """Return whether a record's attributes state a load on the last link; None: not stated."""
    return bool(attributes[LOADED]) if LOADED in attributes else None


@dataclass(frozen=True)
class Record:
    """Samples of one repeat of one step, equally spaced, in SI.

    `channels` maps a channel's name to n samples; `locked` holds the 1-based joints that were
    locked; records of one run that differ only in `repeat` had the same excitation, started at
    the same sample. `period` is the excitation's period in samples (0: not periodic), `lines` the
    excited lines of that period (multiples of 1/period).
    """

    name: str
    step: str
    locked: tuple[int, ...]
    repeat: int
    sample_rate: float
    channels: Mapping[str, Array]
    start: float = 0.0
    period: int = 0
    lines: tuple[int, ...] = ()
    attributes: Mapping[str, str | float | int] = field(default_factory=dict)

    @property
    def loaded(self) -> bool | None:
        """Whether the last link carries a load that it has not in other records; None: unknown."""
        return stated_load(self.attributes)

    @property
    def bandwidth(self) -> float | None:
        """Frequency [Hz] below which the joints' motion is; None: not known."""
        return float(self.attributes[BANDWIDTH]) if BANDWIDTH in self.attributes else None

    @property
    def samples(self) -> int:
        """Number of samples in every channel."""
        return len(next(iter(self.channels.values())))

    @property
    def time(self) -> Array:
        """Time of each sample from the record's first [s], shape (n,)."""
        return np.arange(self.samples) / self.sample_rate


@dataclass(frozen=True)
class RecordHead:
    """Description of a record without its samples; fields as in `Record`."""

    name: str
    step: str
    locked: tuple[int, ...]
    repeat: int
    sample_rate: float
    samples: int
    channels: tuple[str, ...]
    start: float = 0.0
    period: int = 0
    lines: tuple[int, ...] = ()
    attributes: Mapping[str, str | float | int] = field(default_factory=dict)

    def record(self, channels: Mapping[str, Array]) -> Record:
        """Return a record of these channels, each (m,): the whole record or a part of it."""
        return Record(
            self.name, self.step, self.locked, self.repeat, self.sample_rate, channels,
            self.start, self.period, self.lines, self.attributes,
        )  # fmt: skip


def head_of(record: Record) -> RecordHead:
    """Return a record's description without its samples."""
    return RecordHead(
        record.name, record.step, record.locked, record.repeat, record.sample_rate,
        record.samples, tuple(record.channels),
        record.start, record.period, record.lines, record.attributes,
    )  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A run folder's content: the rig, the records, the source."""

    rig: Rig
    records: tuple[Record, ...]
    source: str = ""
    state: str = "done"


def refuse_malformed(runs: Sequence[Run]) -> None:
    """Raise InputError for runs made in Python whose records no analysis can work on.

    Records of run folders and of imports are checked where they are read.
    """
    if isinstance(runs, Run) or not all(isinstance(run, Run) for run in runs):
        raise InputError("expected a list of runs, such as [load_run('runs/monday')]")
    for run in runs:
        for record in run.records:
            if problem := _malformed(record):
                raise InputError(f"record {record.name!r} of {run.source or 'a run'}: {problem}")


def _malformed(record: Record) -> str:
    """Return what is wrong with a record ('' if nothing)."""
    if not (np.isfinite(record.sample_rate) and record.sample_rate > 0):
        return f"its sample rate is {record.sample_rate} Hz, expected a positive number"
    if record.period < 0:
        return f"its period is {record.period} samples, expected 0 (not periodic) or more"
    if not record.channels:
        return "it has no channels"
    for name, samples in record.channels.items():
        if problem := _malformed_samples(samples):
            return f"{name}: {problem}"
    lengths = {len(x) for x in record.channels.values()}
    if len(lengths) > 1:
        return f"its channels have {min(lengths)} to {max(lengths)} samples, expected equally many"
    return "" if lengths != {0} else "it has no samples"


def _malformed_samples(samples: Array) -> str:
    x = np.asarray(samples)
    if x.ndim != 1 or x.dtype.kind != "f" or x is not samples:
        found = f"{type(samples).__name__} of {x.dtype}, shape {x.shape}"
        return f"expected an array (n,) of floats, found {found}"
    return ""


def refuse_repeated_runs(runs: Sequence[Run]) -> None:
    """Raise InputError if two runs have a record with the same samples."""
    known: dict[str, tuple[int, str]] = {}
    sources = [run.source or f"run {k + 1} of {len(runs)}" for k, run in enumerate(runs)]
    for k, run in enumerate(runs if len(runs) > 1 else ()):
        for record in run.records:
            other, name = known.setdefault(samples_digest(record), (k, record.name))
            if other != k:
                raise repeated_run(sources[k], sources[other], (record.name, name))


def samples_digest(record: Record) -> str:
    """Return a digest of a record's samples, the same whatever its name."""
    return channels_digest(record.channels)


def channels_digest(channels: Mapping[str, Array]) -> str:
    """Return a digest of samples (n,) by channel, the same in whatever order they are."""
    digest = hashlib.sha256()
    for name in sorted(channels):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(channels[name], dtype=np.float64).tobytes())
    return digest.hexdigest()


def repeated_run(run: str, known: str, records: tuple[str, str] | None = None) -> InputError:
    """Return the refusal of a run that was given already, or of which `records` are the same."""
    found = "" if records is None else (
        f" in whole or in part (its record {records[0]} is record {records[1]} there, sample for "
        "sample)"
    )  # fmt: skip
    return InputError(
        f"{run}: is the same run as {known}{found}; expected each run once, since repeated samples "
        f"add no information: leave {run} out"
    )


def common_bandwidth(widths: Sequence[float | None]) -> float | None:
    """Return the largest of bandwidths [Hz], None where one is not known or there are none.

    Rows that are fitted together must pass alike filters: what a model misses would else weigh more
    in the wider ones.
    """
    known = [w for w in widths if w is not None]
    return max(known) if known and len(known) == len(widths) else None


def with_common_bandwidth(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return runs whose records state their `common_bandwidth`; those with excited lines none."""
    return of_bandwidth(runs, bandwidth_of(runs))


def bandwidth_of(runs: Sequence[Run]) -> float | None:
    """Return the `common_bandwidth` [Hz] of the records without excited lines."""
    return common_bandwidth([r.bandwidth for run in runs for r in run.records if not r.lines])


def of_bandwidth(runs: Sequence[Run], width: float | None) -> tuple[Run, ...]:
    """Return runs whose records without excited lines state a bandwidth [Hz], or none."""
    return tuple(
        replace(run, records=tuple(r if r.lines else _of_bandwidth(r, width) for r in run.records))
        for run in runs
    )


def _of_bandwidth(record: Record, width: float | None) -> Record:
    if record.bandwidth == width:
        return record
    others = {k: v for k, v in record.attributes.items() if k != BANDWIDTH}
    stated = {} if width is None else {BANDWIDTH: width}
    return replace(record, attributes={**others, **stated})


def with_loads_stated(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return runs whose records all state their load, where one of them does: the others have none.

    Runs in which no record states a load are returned unchanged.
    """
    if all(record.loaded is None for run in runs for record in run.records):
        return tuple(runs)
    return tuple(
        replace(
            run,
            records=tuple(
                replace(r, attributes={LOADED: 0, **r.attributes}) for r in run.records
            ),
        )
        for run in runs
    )  # fmt: skip


def bridged(x: Array) -> Array:
    """Return x (n,) with every gap of NaN interpolated linearly; zeros if all are NaN."""
    missing = np.isnan(x)
    if not missing.any():
        return x
    if missing.all():
        return np.zeros_like(x)
    index = np.arange(len(x))
    filled = x.copy()
    filled[missing] = np.interp(index[missing], index[~missing], x[~missing])
    return filled
