"""Disk space of a run, estimated before it starts."""

from __future__ import annotations

import shutil
from pathlib import Path

from protocols.files.plan import Plan
from rig.model.parse import InputError
from rig.model.rig import Rig

# A sample takes 8 bytes per channel in the journal, the same in records.h5, which is written before
# the journal is removed, and some more in the journal's write-ahead log.
COPIES = 2.5
SPARE = 200e6  # [bytes] to leave free on the disk


def needed_bytes(plan: Plan, rig: Rig) -> float:
    """Return the largest size [bytes] of a run, if every condition reaches its time-out."""
    return COPIES * 8.0 * len(rig.recorded) * rig.sample_rate * plan.longest


def require_space(plan: Plan, rig: Rig, out: Path) -> None:
    """Raise InputError if the disk of `out` has too little free space for the run."""
    folder = out.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    needed = needed_bytes(plan, rig)
    if needed + SPARE > free:
        raise InputError(
            f"{out}: the run needs up to {needed / 1e6:.0f} MB ({plan.longest:.0f} s at "
            f"{rig.sample_rate:g} Hz) and {SPARE / 1e6:.0f} MB to spare, "
            f"the disk has {free / 1e6:.0f} MB; free space, or choose a folder on another disk"
        )
