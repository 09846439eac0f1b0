"""The plant's fixed step is exact enough against scipy, and its figures are given for the bench."""

from __future__ import annotations

import pytest

from rig.cli.bench.plant import accuracy, speed


def test_the_fixed_step_agrees_with_scipy() -> None:
    figures = accuracy(seconds=0.3)
    assert figures["angle_error"] < 1e-6
    assert figures["pressure_error"] < 1e-6


@pytest.mark.slow
def test_speed_is_told_with_a_comparison_at_equal_accuracy() -> None:
    figures = speed(seconds=0.2)
    assert figures["lsoda_error"] <= figures["plant_error"] < 1e-6
    assert figures["real_time_ratio"] > 1
    assert figures["lsoda_ratio"] > 1
