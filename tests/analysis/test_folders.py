"""Run folders streamed by `identify_folders`, against `identify` with everything in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from analysis.identify.streams.out_of_core import identify_folders
from analysis.terms import with_effects
from analysis.terms.base import Used
from rig.model.records import Run
from rig.model.rig import ElectricRig
from rig.runs.archive import write_run
from rig.runs.rigs import load_rig
from tests.analysis.test_accumulate import assert_same
from tests.analysis.test_lost_samples import with_lost
from tests.studies.machines import electric_plant


def test_samples_lost_on_the_wire_are_masked_in_both_ways(
    tmp_path: Path, multisine_run: Run
) -> None:
    holed = with_lost(multisine_run, (3000, 3020), (7000, 7100))
    folder = write_run(tmp_path / "monday", holed)
    shares: list[float] = []
    streamed = identify_folders([str(folder)], progress=shares.append)
    assert_same(streamed, identify([holed], estimator=PLAIN))
    assert len(shares) >= 4  # how far it is, a few records at a time
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_lock_that_gives_is_decided_for_all_repeats_in_both_ways(
    tmp_path: Path, multisine_run: Run
) -> None:
    """A tremble near the noise, which the mean of the repeats shows more clearly than each."""
    records = []
    for record in multisine_run.records:
        channels = dict(record.channels)
        if record.step == "step1":
            tremble = 3e-6 * np.sin(2 * np.pi * 8 * record.time)
            channels["piston_1"] = channels["piston_1"] + tremble
        records.append(replace(record, channels=channels))
    run = replace(multisine_run, records=tuple(records))
    folder = write_run(tmp_path / "monday", run)
    assert_same(identify_folders([str(folder)]), identify([run], estimator=PLAIN))


@pytest.mark.slow
def test_an_effect_is_added_to_the_model_in_both_ways(tmp_path: Path, multisine_run: Run) -> None:
    folder = write_run(tmp_path / "monday", multisine_run)
    result = identify_folders([str(folder)], effects=["torque_offset"])
    terms = [Used(term) for term in with_effects(multisine_run.rig, ["torque_offset"])]
    assert_same(result, identify([multisine_run], terms=terms, estimator=PLAIN))
    assert len(result.estimates) == 18


@pytest.mark.slow
def test_an_electric_robot_streams_too(tmp_path: Path) -> None:
    """With the base's slope, whose parameters are fewer than the rows' unknowns."""
    robot = load_rig("electric-2dof")
    assert isinstance(robot, ElectricRig)
    arm = electric_plant.draw_arm(np.random.default_rng(5))
    run = electric_plant.records(robot, arm, np.random.default_rng(6), repeats=2)
    folder = write_run(tmp_path / "monday", run)
    result = identify_folders([str(folder)])
    assert_same(result, identify([run], estimator="plain"))
    assert "base_inclination" in result.estimates
