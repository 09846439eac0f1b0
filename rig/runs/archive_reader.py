"""Reads records.h5 (layout: `rig.runs.archive`): heads, records, parts of records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from rig.model.parse import InputError
from rig.model.records import Record, RecordHead
from rig.runs.runstate import BETWEEN
from rig.runs.sections import Written

FORMAT = 1
CHUNK: Final = 1_000_000  # samples of a channel in memory at a time
_HEAD = ("step", "locked", "repeat", "sample_rate", "start_s", "period", "lines", "complete")


def head_of(name: str, group: h5py.Group | None, path: Path) -> RecordHead:
    """Return a record's head, without its samples; raises InputError.

    `group` is None if h5py cannot open it.
    """
    if not isinstance(group, h5py.Group):
        raise InputError(
            f"{path}: record {name} cannot be read: the file is damaged; take it from a backup"
        )
    attributes = {key: _python(value) for key, value in group.attrs.items()}
    missing = [key for key in _HEAD if key not in attributes]
    if missing:
        raise InputError(f"{path}: record {name} lacks {missing[0]!r}; take it from a backup")
    lengths = {str(key): group[key].shape for key in group}
    if not lengths or len(set(lengths.values())) != 1:
        raise InputError(f"{path}: record {name}: channels are missing or of unequal length")
    return RecordHead(
        name=name,
        step=str(attributes["step"]),
        locked=tuple(int(j) for j in attributes["locked"]),
        repeat=int(attributes["repeat"]),
        sample_rate=float(attributes["sample_rate"]),
        samples=int(next(iter(lengths.values()))[0]),
        channels=tuple(lengths),
        start=float(attributes["start_s"]),
        period=int(attributes["period"]),
        lines=tuple(int(k) for k in attributes["lines"]),
        attributes={k: v for k, v in attributes.items() if k not in _HEAD[:-1] and k != "kind"},
    )


def samples_of(
    group: h5py.Group, head: RecordHead, first: int = 0, last: int | None = None
) -> Record:
    """Read the samples [first, last) of a record's group; InputError for a wrong checksum."""
    part = slice(first, last)
    columns = {name: _samples(group, name, f"record {head.name}", part) for name in head.channels}
    return head.record(columns)


def _samples(group: h5py.Group, channel: str, place: str, part: slice) -> NDArray[np.float64]:
    """Read a part of a channel (n,); InputError with its place for a wrong checksum."""
    try:
        return np.asarray(group[channel][part], dtype=np.float64)
    except OSError as error:
        raise InputError(
            f"{group.file.filename}: {place}, channel {channel}: samples were changed "
            "or damaged since they were written (their checksum does not match); take the "
            f"file from a backup, or leave this run out ({error})"
        ) from error


def verify(path: Path) -> None:
    """Read every sample of an archive, also those outside of records, for their checksums.

    Raises InputError that names the place and the channel of samples that were changed.
    """
    with readable(path), open_archive(path) as file:
        between = file[BETWEEN].items() if BETWEEN in file else ()
        records = ((f"record {name}", group) for name, group in file.items() if name != BETWEEN)
        for place, group in (*records, *((f"{BETWEEN}/{name}", group) for name, group in between)):
            for channel, data in group.items():
                for first in range(0, len(data), CHUNK):
                    _samples(group, channel, place, slice(first, first + CHUNK))


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Convert any error of h5py on a damaged archive into an InputError with the file's name."""
    try:
        yield
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: not a readable records.h5; take the file from a backup, or leave this run "
            f"out ({error})"
        ) from error


def open_archive(path: Path) -> h5py.File:
    """Open an archive for reading; raises InputError for other files."""
    with readable(path):
        file = h5py.File(path, "r", locking=False)  # a finished archive is never changed in place
        if int(file.attrs.get("format", 0)) != FORMAT:
            file.close()
            raise InputError(f"{path}: not an archive of this version's format {FORMAT}")
        return file


def _python(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


def read_heads(file: h5py.File, path: Path) -> list[RecordHead]:
    """Return the heads of all records in the order of recording."""
    heads = [head_of(name, group, path) for name, group in file.items() if name != BETWEEN]
    return sorted(heads, key=_record_order)


def count(path: Path) -> Written:
    """Count what an archive holds without reading a sample; raises InputError."""
    with readable(path), open_archive(path) as file:
        heads = read_heads(file, path)
        lost = sum(int(head.attributes.get("lost_samples", 0)) for head in heads)
        between = file[BETWEEN].values() if BETWEEN in file else ()
        outside = sum(len(next(iter(group.values()))) for group in between if len(group))
    return Written(
        records=len(heads),
        partial=sum(not head.attributes["complete"] for head in heads),
        samples=sum(head.samples for head in heads) - lost,
        lost_samples=lost,
        damaged_blocks=0,
        outside=outside,
    )


def read_records(path: Path) -> list[Record]:
    """Read all records in the order of recording; raises InputError."""
    with readable(path), open_archive(path) as file:
        return [samples_of(file[head.name], head) for head in read_heads(file, path)]


def _record_order(record: RecordHead) -> tuple[int, int, str]:
    stream, tick = record.attributes.get("stream", 0), record.attributes.get("start_tick", 0)
    return int(stream), int(tick), record.name
