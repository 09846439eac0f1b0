"""A recorded run played as a device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from drivers.base import OFF, DeviceError, DeviceLost, OutputLaw
from drivers.conformance import (
    Capabilities,
    CheckVerdict,
    DeviceUnderTest,
    RandomCallBudget,
    Subject,
    run,
)
from drivers.replay import ReplayDriver
from rig.model.rig import Rig
from rig.runs import archive, store
from tests.hil_sim.integrator import seed_rig

PLAYS = Capabilities(outputs=False, latches_trips=False)


def recording(folder: Path, samples: int = 4000, lost: slice = slice(0, 0)) -> Path:
    """Write a run of three groups whose samples count on from one to the next."""
    rig = seed_rig()
    data = 1e-6 * np.arange(samples)[:, None] + np.zeros(len(rig.recorded))
    data[lost] = np.nan
    third = samples // 3
    with archive.create(folder / store.ARCHIVE, rig.name) as file:
        for group, first, end in (
            ("step1_r1", third, 2 * third),
            ("between/0001", 0, third),
            ("between/0002", 2 * third, samples),
        ):
            columns = {name: data[first:end, i] for i, name in enumerate(rig.recorded)}
            about = {"sample_rate": rig.sample_rate, "stream": 0, "start_tick": 70 + first}
            archive.write_group(file, group, columns, about)
    return folder


def player(run_folder: Path, rig: Rig | None = None, **settings: Any) -> ReplayDriver:
    described = rig or seed_rig()
    wire = described.wire.reached_by("replay", {"run": str(run_folder), **settings})
    return ReplayDriver(wire, described)


def test_it_conforms(tmp_path: Path) -> None:
    recording(tmp_path)

    @contextmanager
    def bench() -> Iterator[DeviceUnderTest]:
        yield DeviceUnderTest(seed_rig(), lambda rig: player(tmp_path, rig))

    report = run(Subject("replay", bench, PLAYS), effort=RandomCallBudget(15, 20, shorten=False))
    assert report.of(CheckVerdict.FAILED) == ()
    passed = {result.check for result in report.of(CheckVerdict.PASSED)}
    assert {"samples_in_order", "other_rig_refused", "random_calls", "zero_any_time"} <= passed


def test_all_samples_are_played_in_the_order_they_were_taken(tmp_path: Path) -> None:
    driver = player(recording(tmp_path, 305))
    driver.connect()
    driver.start()
    blocks = [driver.read_block() for _ in range(31)]
    with pytest.raises(DeviceLost, match="has ended at sample 305"):
        driver.read_block()
    data = np.vstack([block.data for block in blocks])
    assert data[:, 0] == pytest.approx(1e-6 * np.arange(305))
    assert [block.tick for block in blocks] == list(range(0, 305, 10))
    assert [block.sequence for block in blocks] == list(range(31))


def test_samples_lost_in_the_recording_are_counted_missing(tmp_path: Path) -> None:
    driver = player(recording(tmp_path, lost=slice(24, 57)))
    driver.connect()
    driver.start()
    blocks = [driver.read_block() for _ in range(5)]
    assert [(block.tick, len(block.data)) for block in blocks] == [
        (0, 10),
        (10, 10),
        (20, 4),
        (57, 10),
        (67, 10),
    ]
    assert [block.sequence for block in blocks] == [0, 1, 2, 7, 8]


def test_laws_are_refused_or_ignored_and_the_commands_are_those_recorded(tmp_path: Path) -> None:
    law = [OutputLaw(bias=1.0, limit=2.0), OFF]
    driver = player(recording(tmp_path))
    driver.connect()
    driver.apply([OFF, OFF])
    with pytest.raises(DeviceError, match=r"follows no law \(joint 1\).*ignore_outputs"):
        driver.apply(law)
    ignoring = player(tmp_path, ignore_outputs=True)
    ignoring.connect()
    ignoring.start()
    ignoring.apply(law)
    assert ignoring.read_block().data[:, -2] == pytest.approx(1e-6 * np.arange(10))


def test_it_keeps_the_pace_asked_for(tmp_path: Path) -> None:
    rig = seed_rig()
    wire = rig.wire.reached_by("replay", {"run": str(recording(tmp_path)), "pace": 2.0})
    now = [50.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    driver = ReplayDriver(wire, rig, clock=lambda: now[0], sleep=sleep)
    assert not driver.connect().virtual_time
    driver.start()
    for _ in range(100):
        driver.read_block()
    assert now[0] - 50.0 == pytest.approx(1000 / (2.0 * rig.sample_rate))
    now[0] += 0.1  # a slow reader finds what waited
    assert driver.read_block().backlog == pytest.approx(19, abs=1)


def test_what_is_no_recording_says_so(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match=r"absent.*cannot be read"):
        player(tmp_path / "absent").connect()
    torn = tmp_path / "torn.h5"
    torn.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(50))
    with pytest.raises(DeviceLost, match="cannot be read"):
        player(torn).connect()
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = 99
    with pytest.raises(DeviceError, match="format 1"):
        player(tmp_path / "other.h5").connect()
