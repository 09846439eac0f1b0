"""Repeats of a step that did not have the same motion: each becomes a step of its own.

Repeats are averaged, and what differs between them counts as noise. Neither holds where the motion
differs, for example where a recording did not start with the excitation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from analysis.trace.settings import DATA
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.units import plain


def with_other_motions_apart(runs: Sequence[Run]) -> tuple[list[Run], tuple[str, ...]]:
    """Return the runs with repeats of another motion as steps of their own, and notes on them.

    A repeat has another motion where a joint's position differs from that in the step's first
    record by more than `DATA.other_motion` of the standard deviation of the latter.
    """
    out, notes = [], []
    for run in runs:
        first: dict[str, Record] = {}
        records = []
        for record in run.records:
            difference = _difference(run.rig, first.setdefault(record.step, record), record)
            if difference > DATA.other_motion:
                notes.append(
                    f"step {record.step!r}: repeat {record.repeat} differs from the first by "
                    f"{plain(100 * difference, 2)} % of its motion and is taken as a step of its "
                    "own: records of one step must start at the same sample of one excitation"
                )
                records.append(replace(record, step=f"{record.step} repeat {record.repeat}"))
            else:
                records.append(record)
        out.append(replace(run, records=tuple(records)))
    return out, tuple(notes)


def _difference(rig: Rig, first: Record, other: Record) -> float:
    """Return the largest of the free joints' rms differences over the deviation in `first`."""
    noise = rig.sensors.of(rig.position_kind).noise
    largest = 0.0
    for joint in range(1, len(rig.joints) + 1):
        name = ch.channel(rig.position_kind, joint)
        x, y = first.channels[name], other.channels[name]
        count = min(len(x), len(y))
        motion = float(np.std(x[:count]))
        if joint not in first.locked and motion > DATA.seen_motion * noise:
            change = float(np.sqrt(np.mean((y[:count] - x[:count]) ** 2)))
            largest = max(largest, change / motion)
    return largest
