"""Run folders of records at hand: archives that no bench recorded, for studies and figures."""

from __future__ import annotations

from pathlib import Path

from rig.model.records import Run
from rig.runs import archive, store
from rig.runs.runstate import release_ownership


def write_run(folder: str | Path, run: Run) -> Path:
    """Write a finished run folder of records at hand; raises InputError if it is occupied."""
    path = store.create_run(Path(folder), run.rig, source=run.source)
    fresh = path / f"{archive.NAME}.tmp"
    with archive.create(fresh, run.rig.name) as file:
        for order, r in enumerate(run.records):
            about = archive.record_attributes(
                r.step, r.repeat, r.locked, r.sample_rate, r.start, r.period, r.lines, True
            )
            more = {**r.attributes, **about, "stream": order, "start_tick": 0}
            archive.write_group(file, r.name, r.channels, more, run.rig.unit_of)
    archive.put_in_place(fresh, path / archive.NAME)
    store.mark_done(path)
    release_ownership(path)
    return path
