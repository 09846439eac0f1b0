"""How far a metering edge is open: sharp far from it, half its rounding at it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.effects.edges import edge, opened
from analysis.effects.underlap import UnderlapLeakage
from analysis.effects.valve import ValveDeadband
from rig.model.rig import Rig

ROUNDING = 4e-3  # [V]


@given(
    st.floats(-1.0, 1.0), st.floats(0.0, 0.1).filter(lambda r: r == 0 or r > 1e-9),
    st.floats(0.0, 10.0),
)  # fmt: skip
def test_rounding_opens_an_edge_by_no_more_than_its_half_and_most_at_the_edge(
    x: float, r: float, c: float
) -> None:
    more = float(opened(np.array([x]), r, c)[0]) - max(x, 0.0)
    assert -1e-12 <= more <= 0.5 * r + 1e-12
    assert float(opened(np.zeros(1), r, c)[0]) == pytest.approx(0.5 * r, abs=1e-12)
    assert edge(x, r, c) == pytest.approx(max(x, 0.0) + more, abs=1e-12)


def test_with_clearance_alone_the_orifice_is_as_wide_as_the_hypotenuse() -> None:
    x = np.linspace(-0.02, 0.02, 401)
    both = opened(x, ROUNDING, 0.0) + opened(-x, ROUNDING, 0.0)
    assert both == pytest.approx(np.abs(x + 1j * ROUNDING))
    assert both == pytest.approx(opened(x, ROUNDING, 1e-9) + opened(-x, ROUNDING, 1e-9))


def test_a_worn_corner_is_straight_again_sooner_than_a_clearance() -> None:
    # A parabola between two tangents, 8 mV either side of the edge.
    x = np.linspace(-0.02, 0.02, 401)
    worn = np.where(np.abs(x) < 8e-3, (x + 8e-3) ** 2 / 32e-3, np.maximum(x, 0.0))
    off = [
        min(float(np.sqrt(np.mean((opened(x, r, c) - worn) ** 2))) for r in np.linspace(2e-3, 6e-3))
        for c in (0.0, 2.0)
    ]
    assert off[1] < 0.3 * off[0]


@pytest.mark.parametrize("kind", [ValveDeadband, UnderlapLeakage])
def test_a_shape_without_a_corner_is_that_of_clearance(
    rig: Rig, kind: type[ValveDeadband] | type[UnderlapLeakage]
) -> None:
    effect = kind("joint 2")
    plain = [s.middle for s in effect.shapes(rig) if not s.detail]
    names = [c.parameter for c in effect.coefficients(rig)]
    values = dict.fromkeys(names, 1.0)
    assert np.array_equal(effect.pack(rig, values, plain), effect.pack(rig, values, [*plain, 0.0]))


@pytest.mark.parametrize(("rounding", "c", "closes"), [(0.0, 0.0, True), (0.008, 2.0, True),
                                                       (0.02, 10.0, False)])  # fmt: skip
def test_edges_that_do_not_close_are_no_dead_band(
    rig: Rig, rounding: float, c: float, closes: bool
) -> None:
    # With the rounding as wide as the overlap the valve has half its gain there, and no band.
    problem = ValveDeadband("joint 2").problem(rig, {}, (0.02, 0.02, rounding, c))
    assert (not problem) == closes
    if not closes:
        assert problem.startswith("the edges do not close: the gain at the null is 4")
