"""Runs as files for other programs: CSV, MAT, Parquet or MDF 4, one file per record, SI units.

CSV and MAT include a manifest and the rig, so that `bramah import` restores the same run.
"""

from __future__ import annotations

import csv
import importlib.util
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from rig.model.parse import InputError
from rig.model.records import LOADED, Record, stated_load
from rig.model.rig import Rig
from rig.runs import store
from rig.runs.files import new_folder
from rig.runs.runstate import read_events, stream_clocks
from rig.runs.stream import RunHead, iterate_records, read_run_head

Array = NDArray[np.float64]

TIME: Final = "time"
MODEL: Final = "model_"  # prefix of a channel simulated by a model
RIG_FILE: Final = "rig.yaml"
MANIFEST: Final = "manifest.yaml"
LIBRARIES: Final = {"parquet": "pyarrow", "mf4": "asammdf"}
_RIG_NOTE = "# The rig as it was when this run was taken. Numbers are SI.\n"
_MANIFEST_NOTE = "# bramah import {name} --out RUN makes a run of these files.\n"
_LONG = 63  # longest name in MATLAB [characters]


@dataclass(frozen=True)
class Sheet:
    """One record for a file: columns (n,) by name, the time first; units; attributes."""

    columns: Mapping[str, Array]
    units: Mapping[str, str]
    about: Mapping[str, Any]


def library_missing(kind: str) -> str:
    """Return the name of a format's library that is not installed, '' if all are."""
    name = LIBRARIES.get(kind, "")
    return name if name and importlib.util.find_spec(name) is None else ""


def export_run(
    run: Path, out: Path, kind: str,
    more: Callable[[Record], Mapping[str, Array]] | None = None,
) -> list[Path]:  # fmt: skip
    """Write every complete record of a run into the folder `out`; returns the files.

    `more` returns further channels of a record, each (n,), written as `model_NAME` in the unit of
    `NAME`. One record is in memory at a time. Raises InputError for an unknown format, an
    unreadable run, or an occupied folder.
    """
    if kind not in WRITERS:
        raise InputError(f"--format {kind}: expected one of: {' '.join(WRITERS)}")
    head = read_run_head(run)
    store.refuse_occupied(out)
    began = _began(run)
    names = []
    with new_folder(out) as folder:  # a partial export would look complete
        for record in iterate_records(run):
            names.append(f"{record.name}.{kind}")
            added = {} if more is None else more(record)
            WRITERS[kind](folder / names[-1], sheet(head.rig, record, added, began))
        if kind in ("csv", "mat"):
            names += _write_manifest(run, folder, head, kind)
    return [out / name for name in names]


def _began(run: Path) -> datetime:
    """Return the date at time 0 of a run: of its first block, else of its folder."""
    clocks = stream_clocks(read_events(run))
    if not clocks:
        return datetime.fromisoformat(store.read_header(run).created)
    clock = clocks[min(clocks)]
    return datetime.fromisoformat(clock.host) - timedelta(seconds=clock.began)


def sheet(rig: Rig, record: Record, more: Mapping[str, Array], began: datetime) -> Sheet:
    """Return a record as columns: time, its channels, then `model_NAME` of `more`.

    `began` is the date at time 0.
    """
    order = [name for name in rig.recorded if name in record.channels]
    names = [*order, *(name for name in record.channels if name not in order)]
    columns = {TIME: record.start + record.time} | {name: record.channels[name] for name in names}
    units = {TIME: "s"} | {name: rig.unit_of(name) for name in names}
    columns |= {MODEL + name: values for name, values in more.items()}
    units |= {MODEL + name: rig.unit_of(name) for name in more}
    about = {
        **record.attributes,
        "rig": rig.name,
        "run_began": began.isoformat(),
        "record": record.name,
        "step": record.step,
        "repeat": record.repeat,
        "locked": list(record.locked),
        "sample_rate": record.sample_rate,
        "period": record.period,
        "lines": list(record.lines),
    }
    arrays = {k: v.tolist() for k, v in about.items() if isinstance(v, np.ndarray | np.generic)}
    return Sheet(columns, units, about | arrays)


def _write_csv(path: Path, sheet: Sheet) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(sheet.columns)
        # repr has the fewest digits that give the same number when read.
        writer.writerows(zip(*(c.tolist() for c in sheet.columns.values()), strict=True))


def _write_mat(path: Path, sheet: Sheet) -> None:
    from scipy.io import savemat  # noqa: PLC0415 - slow to load

    about = {name[:_LONG]: value for name, value in sheet.about.items()}
    data = {**sheet.columns, "about": about, "units": dict(sheet.units)}
    savemat(path, data, long_field_names=True, oned_as="column", do_compression=True)


def _write_parquet(path: Path, sheet: Sheet) -> None:
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import parquet  # noqa: PLC0415

    fields = [pa.field(n, pa.float64(), metadata={"unit": sheet.units[n]}) for n in sheet.columns]
    about = {name: json.dumps(value) for name, value in sheet.about.items()}
    table = pa.table(list(sheet.columns.values()), schema=pa.schema(fields, metadata=about))
    with path.open("wb") as file:  # it opens names in UTF-8 only
        parquet.write_table(table, file)


def _write_mf4(path: Path, sheet: Sheet) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415 - an extra, and slow to load

    time = sheet.columns[TIME]
    signals = [
        Signal(samples=values, timestamps=time, name=name, unit=sheet.units[name])
        for name, values in sheet.columns.items()
        if name != TIME
    ]
    with MDF(version="4.10") as file:
        file.header.start_time = datetime.fromisoformat(sheet.about["run_began"])
        file.append(signals, comment=json.dumps(dict(sheet.about)), common_timebase=True)
        file.save(path)


WRITERS: Final[Mapping[str, Callable[[Path, Sheet], None]]] = {
    "csv": _write_csv,
    "mat": _write_mat,
    "parquet": _write_parquet,
    "mf4": _write_mf4,
}


def _write_manifest(run: Path, out: Path, head: RunHead, kind: str) -> list[str]:
    """Write the rig and the manifest that `import` takes; returns their names."""
    header = store.read_header(run)
    resolved = {
        "format": header.format,
        "created": header.created,
        "rig": head.rig.model_dump(mode="json"),
    }
    records = []
    for r in head.records:
        entry: dict[str, Any] = {
            "file": f"{r.name}.{kind}", "name": r.name, "step": r.step, "repeat": r.repeat,
            "locked": list(r.locked),
        }  # fmt: skip
        if r.period:
            entry |= {"period": r.period, "lines": list(r.lines)}
        if stated_load(r.attributes) is not None:
            entry[LOADED] = stated_load(r.attributes)
        records.append(entry)
    manifest = {"rig": RIG_FILE, "records": records}
    written = {
        RIG_FILE: _RIG_NOTE + yaml.safe_dump(resolved, sort_keys=False),
        MANIFEST: _MANIFEST_NOTE.format(name=MANIFEST) + yaml.safe_dump(
            manifest, sort_keys=False, default_flow_style=None, width=100
        ),
    }  # fmt: skip
    for name, text in written.items():
        (out / name).write_text(text, encoding="utf-8")
    return list(written)
