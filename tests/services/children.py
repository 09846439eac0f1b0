"""Start `child.py` and read what it left behind."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from rig.runs.rigs import load_rig
from tests.forked import Forked
from tests.services.fake_driver import samples

RIG = load_rig("shinshu-2dof")


def start(run: Path, mode: str, number: int) -> Forked:
    return Forked([run, mode, number], module="tests.services.child")


def finish(run: Path, mode: str, number: int) -> tuple[int, str]:
    child = start(run, mode, number)
    _, said = child.communicate(timeout=60)
    return child.returncode, said


def acknowledged(run: Path) -> int:
    return int(run.with_suffix(".ack").read_bytes() or b"0")


def measured(run: Path) -> np.ndarray:
    """All of piston_1 in the archive, in the order of ticks, from plain h5py."""
    with h5py.File(run / "records.h5") as file:
        groups = [file[name] for name in file if name != "between"]
        groups += list(file["between"].values()) if "between" in file else []
        groups.sort(key=lambda group: group.attrs["start_tick"])
        return np.concatenate([group["piston_1"][:] for group in groups])


def assert_all_there(run: Path) -> None:
    found = measured(run)
    known = samples(RIG, np.arange(len(found)))[:, RIG.recorded.index("piston_1")]
    np.testing.assert_array_equal(found, known)
    assert len(found) >= acknowledged(run)
