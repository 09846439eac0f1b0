"""records.h5: plain HDF5 that h5py and MATLAB open; one group per record, units as attributes.

Layout: `/NAME` is a record with one float64 dataset per channel (attribute `units`), its chunks
with HDF5's checksum (fletcher32), so that every reader refuses a sample changed later. Attributes
of the group: step, repeat, locked joints, period, lines, lost samples and the protocol's notes.
`/between/0001 ...` hold the samples outside all records, so that the journal can be removed. Lists
are one-dimensional integer arrays, flags are 0 or 1, text is UTF-8. Read by
`rig.runs.archive_reader`.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.records import Run
from rig.model.trips import RecordingFailed
from rig.runs import store
from rig.runs.archive_reader import FORMAT
from rig.runs.files import sync_to_disk
from rig.runs.journal import Journal
from rig.runs.runstate import BETWEEN, DONE, StreamClock, read_events, stream_clocks, write_state
from rig.runs.sections import Assembled, Section, Written, assemble, blocks_of, plan

Array = NDArray[np.float64]

_CHUNK = 1 << 14  # chunk size [samples], read and checked as a whole


def write_group(
    file: h5py.File,
    group: str,
    columns: Mapping[str, Array],
    attributes: Mapping[str, Any],
    unit_of: Callable[[str], str] = ch.unit_of,
) -> None:
    """Write one group: a dataset with `units` per channel, attributes on the group."""
    target = file.create_group(group)
    for key, value in attributes.items():
        target.attrs[key] = _attribute_value(value)
    for name, values in columns.items():
        data = np.ascontiguousarray(values, dtype="<f8")
        # A checksum needs chunks, which need a length above 0.
        whole = data.ndim == 1 and len(data) > 0
        dataset = target.create_dataset(
            name, data=data, fletcher32=whole, chunks=(min(len(data), _CHUNK),) if whole else None
        )
        dataset.attrs["units"] = unit_of(name)


def _attribute_value(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)  # HDF5 would store an enumeration
    if isinstance(value, (tuple, list)):
        return np.array(value, dtype=np.int64)
    return value


def record_attributes(
    meta: Mapping[str, Any], sample_rate: float, start: float, *, complete: bool
) -> dict[str, Any]:
    """Return the attributes that every record has; `meta` holds those of its description."""
    return {
        "kind": "record",
        "step": meta["step"],
        "repeat": meta["repeat"],
        "locked": list(meta["locked"]),
        "sample_rate": sample_rate,
        "start_s": start,
        "period": meta["period"],
        "lines": list(meta["lines"]),
        "complete": int(complete),
    }


def _attributes(
    section: Section, sample_rate: float, counted: Assembled, clock: StreamClock | None
) -> dict[str, Any]:
    meta = section.meta
    device = section.start / sample_rate
    start = device if clock is None else clock.at(section.start, sample_rate)
    attributes = {"kind": BETWEEN, "sample_rate": sample_rate, "start_s": start}
    if meta:
        attributes = record_attributes(meta, sample_rate, start, complete=section.complete)
    return {
        **meta.get("attributes", {}),
        **attributes,
        "stream": section.stream,
        "start_tick": section.start,
        "device_s": device,
        **({} if clock is None else {"stream_host_time": clock.host, "stream_s": clock.began}),
        "ticks": section.ticks,
        "lost_samples": counted.lost,
        "damaged_blocks": counted.damaged_blocks,
        "late_blocks": counted.late_blocks,
        "jitter_max_s": counted.jitter_max,
        "saturated_samples": int(counted.saturated.sum()),
    }


class _Output(io.FileIO):
    """A new file that keeps its first write error as `failure` and discards what follows.

    HDF5 never sees an error, because one may crash the process.
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of `data`, unless a write has failed; return its length [bytes]."""
        unwritten = memoryview(data)
        size = len(unwritten)
        try:
            while unwritten and self.failure is None:
                unwritten = unwritten[super().write(unwritten) :]
        except OSError as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the file's size [bytes], unless that fails; return it."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0


@contextmanager
def create(path: Path, rig_name: str) -> Iterator[h5py.File]:
    """Yield a new archive with its root attributes; raises OSError if a part cannot be written."""
    with _Output(path, "w+") as output:
        with h5py.File(output, "w", libver=("earliest", "v110")) as file:
            file.attrs["format"] = FORMAT
            file.attrs["creator"] = "bramah"
            file.attrs["rig"] = rig_name
            yield file
        if output.failure is not None:
            raise output.failure


def put_in_place(fresh: Path, path: Path) -> None:
    """Rename a finished archive to its final name, synchronised to disk."""
    sync_to_disk(fresh)
    os.replace(fresh, path)
    sync_to_disk(path.parent)


def write_from_journal(journal: Journal, folder: Path, rig_name: str) -> Written:
    """Write records.h5 and verify it against the journal, sample by sample.

    Returns the counts of its content; on failure raises RecordingFailed and leaves no archive.
    """
    spans = journal.spans()
    sections = plan(journal, spans)
    columns, rate = journal.meta("columns"), float(journal.meta("sample_rate"))
    clocks = stream_clocks(read_events(folder))
    fresh = folder / f"{store.ARCHIVE}.tmp"
    lost = 0
    try:
        with create(fresh, rig_name) as file:
            for section in sections:
                assembled = assemble(journal, spans, section)
                attributes = _attributes(section, rate, assembled, clocks.get(section.stream))
                channels = {name: assembled.data[:, i] for i, name in enumerate(columns)}
                write_group(file, section.group, channels, attributes)
                # Commands have no saturation flags.
                for name, count in zip(columns, assembled.saturated, strict=False):
                    file[section.group][name].attrs["saturated_samples"] = int(count)
                lost += assembled.lost if section.meta else 0
        damaged = verify(journal, fresh, sections)
        put_in_place(fresh, folder / store.ARCHIVE)
    except (OSError, RuntimeError) as error:  # h5py reports a failed flush as RuntimeError
        fresh.unlink(missing_ok=True)
        raise RecordingFailed(
            f"{folder / store.ARCHIVE}: cannot be written ({error}); the journal keeps every "
            "sample: free some disk space, then `bramah recover` this run"
        ) from error
    records = [section for section in sections if section.meta]
    partial = sum(not section.complete for section in records)
    samples = sum(section.ticks for section in records) - lost
    outside = sum(section.ticks for section in sections if not section.meta)
    return Written(len(records), partial, samples, lost, damaged, outside)


def verify(journal: Journal, path: Path, sections: Sequence[Section]) -> int:
    """Compare every sample of the journal with the archive; raises OSError on a difference.

    Returns the number of journal blocks with a wrong checksum, which cannot be compared.
    """
    columns, spans = journal.meta("columns"), journal.spans()
    total = damaged = 0
    with h5py.File(path, "r", locking=False) as file:
        for section in sections:
            stored = np.column_stack([file[section.group][name][:] for name in columns])
            if stored.shape != (section.ticks, len(columns)):
                count = f"{len(stored)} samples, not {section.ticks}"
                raise OSError(f"group {section.group} has {count}")
            arrived = 0
            for block, rows, block_rows in blocks_of(journal, spans, section):
                if block is None:
                    damaged += 1
                    continue
                if not np.array_equal(stored[rows], block.data[block_rows], equal_nan=True):
                    raise OSError(f"group {section.group} differs at tick {block.tick}")
                arrived += block_rows.stop - block_rows.start
            if arrived + int(file[section.group].attrs["lost_samples"]) != section.ticks:
                raise OSError(f"group {section.group} has a wrong count of lost samples")
            total += arrived
    if not damaged and total < int(spans.samples.sum()):
        raise OSError(
            f"only {total} of {int(spans.samples.sum())} samples of the journal are in it"
        )
    return damaged


def write_run(folder: str | Path, run: Run) -> Path:
    """Write a finished run folder from records in memory, completely or not at all.

    Raises InputError if it is occupied, RecordingFailed if it cannot be written.
    """
    out = Path(folder)
    with store.whole_run(out, run.rig, run.source) as path:
        with create(path / store.ARCHIVE, run.rig.name) as file:
            for order, r in enumerate(run.records):
                described = record_attributes(vars(r), r.sample_rate, r.start, complete=True)
                attributes = {**r.attributes, **described, "stream": order, "start_tick": 0}
                write_group(file, r.name, r.channels, attributes, run.rig.unit_of)
        write_state(path, DONE)
    return out
