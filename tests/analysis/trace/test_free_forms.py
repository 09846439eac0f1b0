"""A free form must explain what it alters; held-out records judge the other equations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from analysis.trace.free_forms import _explains_what_it_alters
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.search.hypothesis import Hypothesis


class Tolerant:
    """A collection of sets in which an equation may keep an energy of 100."""

    def negligible(self, equation: str, residual: float) -> bool:
        return residual <= 100.0


def leaving(**energy: float) -> Hypothesis:
    return Hypothesis((), ExactFit((), {}, np.zeros(1), np.zeros((0, 0))), energy, (1, 1))


@pytest.mark.parametrize(
    ("torque", "flow", "explains"),
    [(50.0, 700.0, True), (50.0, 650.0, True), (50.0, 400.0, False), (200.0, 700.0, False)],
)
def test_a_flow_that_a_friction_curve_leaves_alone_does_not_count_against_it(
    torque: float, flow: float, explains: bool
) -> None:
    """Before: 10 000 in the torque balance, 700 in the flow, which only a stick-slip disturbs."""
    wide: Any = Tolerant()
    before, after = (
        leaving(torque_2=1e4, flow_cap_2=700.0),
        leaving(torque_2=torque, flow_cap_2=flow),
    )
    assert _explains_what_it_alters(wide, before, after) is explains
