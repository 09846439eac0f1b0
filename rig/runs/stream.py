"""Reads runs in parts: heads first, then one record, or part of a record, at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py

from rig.model.records import Record, RecordHead
from rig.model.rig import Rig
from rig.runs import archive_reader, store


@dataclass(frozen=True)
class RunHead:
    """A run without samples: rig, heads of its records, path and final state."""

    rig: Rig
    records: tuple[RecordHead, ...]
    source: str
    state: str


class RecordReader:
    """One record of an open archive; its samples are read on request."""

    def __init__(self, path: Path, group: h5py.Group, head: RecordHead) -> None:
        self.head = head
        self._path = path
        self._group = group

    def read(self, first: int = 0, last: int | None = None) -> Record:
        """Return the samples [first, last) as a record."""
        with archive_reader.readable(self._path):
            return archive_reader.samples_of(self._group, self.head, first, last)


def read_run_head(path: str | Path, *, partial: bool = False) -> RunHead:
    """Read a run's heads; raises InputError as `store.load_run` does."""
    folder = Path(path)
    header, state = store.finished(folder)
    file_path = folder / store.ARCHIVE
    with archive_reader.readable(file_path), archive_reader.open_archive(file_path) as file:
        heads = archive_reader.read_heads(file, file_path)
    chosen = store.chosen_of(folder, state, heads, partial)
    return RunHead(header.rig, chosen, str(folder), state)


@contextmanager
def open_record(path: str | Path, name: str) -> Iterator[RecordReader]:
    """Open one record of a run for reading in parts; raises InputError."""
    file_path = Path(path) / store.ARCHIVE
    with archive_reader.open_archive(file_path) as file:
        with archive_reader.readable(file_path):
            group = file[name]
            head = archive_reader.head_of(name, group, file_path)
        yield RecordReader(file_path, group, head)


def iterate_records(path: str | Path) -> Iterator[Record]:
    """Yield a run's records in the order of recording, one in memory at a time.

    Raises InputError as `store.load_run` does.
    """
    for head in read_run_head(path).records:
        with open_record(path, head.name) as reader:
            record = reader.read()
        yield record
