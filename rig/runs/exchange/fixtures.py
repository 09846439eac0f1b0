"""Run folders from records in memory, for studies and figures."""

from __future__ import annotations

from pathlib import Path

from rig.model.records import Run
from rig.runs import archive, store


def write_run(folder: str | Path, run: Run) -> Path:
    """Write a finished run folder from records in memory, completely or not at all.

    Raises InputError if it is occupied, RecordingFailed if it cannot be written.
    """
    out = Path(folder)
    with store.whole_run(out, run.rig, run.source) as path:
        with archive.create(path / archive.NAME, run.rig.name) as file:
            for order, r in enumerate(run.records):
                about = archive.record_attributes(
                    r.step, r.repeat, r.locked, r.sample_rate, r.start, r.period, r.lines, True
                )
                more = {**r.attributes, **about, "stream": order, "start_tick": 0}
                archive.write_group(file, r.name, r.channels, more, run.rig.unit_of)
        store.mark_done(path)
    return out
