"""The engine and the real bench session: what was recorded is on the disk, with its attributes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DeviceInfo, OutputLaw, SampleBlock
from protocols.engine.engine import run
from protocols.engine.states import LockFailed
from protocols.files.library import load
from protocols.files.plan import Overrides, resolve
from protocols.language.waveforms import Array
from rig.bench.session import Bench
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from tests.protocols.little_bench import LittleBench, default_cylinders


class LittleDriver:
    """The little plant as a driver, without a wire."""

    def __init__(self, plant: LittleBench) -> None:
        self.plant = plant
        self.zeroed = 0

    def connect(self) -> DeviceInfo:
        return self.plant.info

    def close(self) -> None:
        self.zero_outputs()

    def zero_outputs(self) -> None:
        self.zeroed += 1
        self.plant.laws = [OutputLaw()] * len(self.plant.laws)

    def upload(self, joint: int, wave: Array) -> None:
        self.plant.upload(joint, wave)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        return self.plant.apply(laws, restart)

    def start(self) -> None: ...

    def read_block(self) -> SampleBlock:
        return self.plant.exchange()

    def stop(self) -> None: ...

    def trip_cause(self) -> str | None:
        return None

    def reset(self) -> None: ...


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def test_a_run_ends_as_records_that_the_analysis_can_load(rig: Rig, tmp_path: Path) -> None:
    plan = resolve(load("validate"), rig, Overrides(repeats=2, steps=("step1_3hz", "both_3hz")))
    plant = LittleBench(rig, default_cylinders())
    driver = LittleDriver(plant)
    with Bench(rig, driver, Recorder(tmp_path / "run", rig), signals=False) as bench:
        run(plan, rig, bench)
    found = load_run(tmp_path / "run")
    assert found.state == "done"
    assert [r.name for r in found.records] == list(plan.records)
    first = found.records[0]
    assert (first.step, first.locked, first.repeat) == ("step1_3hz", (1,), 1)
    assert (first.period, first.lines, first.samples) == (1000, (3,), 5000)
    assert first.attributes["lock_1"] == "closed"
    assert first.attributes["excited"] == "2"
    assert first.attributes["lost_samples"] == 0
    kept = plant.channel("piston_2", int(first.attributes["start_tick"]), 5000)
    np.testing.assert_array_equal(first.channels["piston_2"], kept)
    assert plant.laws == [OutputLaw()] * 2


def test_a_lock_that_breaks_leaves_zero_outputs_and_the_records_before_it(
    rig: Rig, tmp_path: Path
) -> None:
    plan = resolve(load("validate"), rig, Overrides(repeats=3, steps=("step1_3hz",)))
    plant = LittleBench(rig, default_cylinders())
    driver = LittleDriver(plant)
    phases: list[tuple[str, int]] = []

    def watch(step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
        phases.append((phase, repeat))
        if (phase, repeat) == ("record", 2):
            plant.cylinders[0].load = 0.004

    with (
        pytest.raises(LockFailed, match="joint 1 moved while locked"),
        Bench(rig, driver, Recorder(tmp_path / "run", rig), signals=False) as bench,
    ):
        run(plan, rig, bench, watch)
    assert phases[-1] == ("record", 2)
    assert driver.zeroed > 0
    assert plant.laws == [OutputLaw()] * 2
    found = load_run(tmp_path / "run")
    assert found.state == "aborted"
    assert "step1_3hz_r1" in [r.name for r in found.records]
