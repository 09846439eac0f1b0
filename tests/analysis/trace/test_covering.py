"""Where nothing explains a residual the next experiment goes where no record has been."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.trace.next_experiment.discrimination import (
    MeasurementView,
    measurement_view,
    noise_ratios,
)
from analysis.trace.next_experiment.excitations import (
    FAMILIES,
    CandidateExcitation,
    excitation,
    joint_settings,
)
from analysis.trace.next_experiment.proposal import LINES, more_lines, wider_range
from analysis.trace.result import Dependence
from tests.analysis.trace.test_next_experiment import sine


@pytest.fixture(scope="module")
def candidates() -> tuple[list[CandidateExcitation], list[MeasurementView]]:
    """Joint 2 moved at creeping speed and at all frequencies, on the twin of the bench."""
    rig, train_data = sine()
    first = joint_settings(rig, train_data.records)[0]
    families = [f for f in FAMILIES if f.name in ("creep", "wide")]
    tried = [excitation(rig, first, family, np.random.default_rng(1)) for family in families]
    found = [one for one in tried if one is not None]
    assert [one.family.name for one in found] == ["wide", "creep"]
    return found, [measurement_view(train_data, one, noise_ratios(train_data)) for one in found]


def clue(variable: str, by: str = "") -> Dependence:
    return Dependence(variable, 0.5, "torque_2", by)


def test_what_moves_with_the_acceleration_asks_for_faster_lines(
    candidates: tuple[list[CandidateExcitation], list[MeasurementView]],
) -> None:
    _, train_data = sine()
    found = wider_range(train_data, [clue("acceleration_2")], candidates[1], 1.3)
    assert found is not None
    assert candidates[0][found.index].family.name == "wide"
    assert found.times > 1.3
    assert "the range of acceleration_2" in found.words


def test_a_clue_that_cannot_be_carried_farther_yields_to_the_next(
    candidates: tuple[list[CandidateExcitation], list[MeasurementView]],
) -> None:
    _, train_data = sine()
    moves = [clue("time"), clue("piston_2", "acceleration_2")]
    found = wider_range(train_data, moves, candidates[1], 1.3)
    assert found is not None
    assert found.variable == "acceleration_2"  # the sine has been all over the stroke
    assert wider_range(train_data, moves, candidates[1], 1e3) is None


def test_records_of_one_sine_ask_for_many_lines(
    candidates: tuple[list[CandidateExcitation], list[MeasurementView]],
) -> None:
    _, train_data = sine()
    found = more_lines(train_data, [clue("supply_pressure")], candidates[0])
    assert found is not None
    assert (found.variable, candidates[0][found.index].family.name) == (LINES, "wide")
    assert "frequencies instead of 1" in found.words
    assert (
        more_lines(train_data, [clue("supply_pressure")], candidates[0][1:]) is None
    )  # creep has 2 lines
