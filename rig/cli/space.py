"""The disk that a run will need, estimated before anything moves."""

from __future__ import annotations

import shutil
from pathlib import Path

from protocols.files.plan import Plan
from rig.model.parse import InputError
from rig.model.rig import Rig

# A sample is 8 bytes a channel in the journal, and once more in the records that are written from
# it before it goes; the journal's write-ahead log adds its share.
COPIES = 2.5
SPARE = 200e6  # [bytes] left to everything else on the disk


def needed_bytes(plan: Plan, rig: Rig) -> float:
    """Return the bytes a run may take while it is finished, every condition at its time-out."""
    return COPIES * 8.0 * len(rig.recorded) * rig.sample_rate * plan.longest


def require_space(plan: Plan, rig: Rig, out: Path) -> None:
    """Raise InputError where the disk under `out` will not hold the run."""
    folder = out.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    needed = needed_bytes(plan, rig)
    if needed + SPARE > free:
        raise InputError(
            f"{out}: the run needs up to {needed / 1e6:.0f} MB ({plan.longest:.0f} s at "
            f"{rig.sample_rate:g} Hz) and {SPARE / 1e6:.0f} MB to spare, "
            f"the disk has {free / 1e6:.0f} MB; free some, or write elsewhere"
        )
