"""The samples around a trip, in the run's file `trip.csv`, for a person to inspect.

They are also in `records.h5`, where the trip divides them into a record and the samples after it.
"""

from __future__ import annotations

import logging
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from rig.model.parse import InputError
from rig.runs import store
from rig.runs.archive_reader import open_archive, readable
from rig.runs.exchange.settings import EXCHANGE
from rig.runs.runstate import BETWEEN, read_events

log = logging.getLogger(__name__)


def write_trip_window(folder: Path) -> Path | None:
    """Write the samples around a finished run's trip; returns the file, None if there is none.

    The columns are `time [s]` since the offending sample, `tick`, and every channel in SI. A sample
    that never arrived is left out. Never raises, because the run is complete without the file.
    """
    trips = [e for e in read_events(folder) if e.get("event") == "trip"]
    if not trips or not isinstance(trips[-1].get("tick"), int):
        return None
    path = folder / store.TRIP_WINDOW
    try:
        with readable(folder / store.ARCHIVE), open_archive(folder / store.ARCHIVE) as file:
            names, table = _around(file, trips[-1]["tick"])
        heading = ",".join(["time [s]", "tick", *names])
        formats = ["%.6f", "%d", *["%.9g"] * len(names)]
        np.savetxt(path, table, delimiter=",", header=heading, comments="", fmt=formats)
    except (InputError, OSError) as error:
        log.warning("%s: cannot be written: %s", path, error)
        return None
    return path


def _around(file: h5py.File, tick: int) -> tuple[list[str], NDArray[np.float64]]:
    """Return (names with units, rows) of the samples of the last stream around a tick."""
    groups = [group for name, group in file.items() if name != BETWEEN]
    groups += list(file[BETWEEN].values()) if BETWEEN in file else []
    last_stream = max(int(group.attrs["stream"]) for group in groups)
    groups = [group for group in groups if int(group.attrs["stream"]) == last_stream]
    channels = list(groups[0])
    names = [f"{name} [{groups[0][name].attrs['units']}]" for name in channels]
    parts = []
    for group in groups:
        start, rate = int(group.attrs["start_tick"]), float(group.attrs["sample_rate"])
        reach = round(EXCHANGE.trip_seconds * rate)
        ticks = np.arange(start, start + int(group.attrs["ticks"]))
        near = np.flatnonzero((ticks >= tick - reach) & (ticks <= tick + reach))
        if len(near) == 0:
            continue
        rows = slice(int(near[0]), int(near[-1]) + 1)
        values = [group[name][rows] for name in channels]
        parts.append(np.column_stack([(ticks[rows] - tick) / rate, ticks[rows], *values]))
    table = np.concatenate(parts)
    table = table[np.isfinite(table[:, 2:]).any(axis=1)]
    # A sample may be in two records; it is written once, in order of time.
    _, distinct = np.unique(table[:, 1], return_index=True)
    return names, table[distinct]
