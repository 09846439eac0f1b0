"""How far a metering edge is open: sharp far from it, half its rounding at it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from analysis.effects.edges import edge, opened
from analysis.effects.underlap import UnderlapLeakage
from analysis.effects.valve import ValveDeadband
from rig.model.parameters import gain_names
from rig.model.rig import Rig

Array = NDArray[np.float64]

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


def test_an_overlap_within_worn_corners_leaves_the_valve_open_at_its_null(rig: Rig) -> None:
    """Corners worn by 20 mV either side of edges that overlap by 5 mV: an underlap below 0."""
    u = np.linspace(-0.06, 0.06, 601)

    def worn(x: Array) -> Array:
        inside = (x + 0.02) ** 2 / 0.08
        return np.where(np.abs(x) < 0.02, inside, np.maximum(x, 0.0))

    def misfit(shape: Array) -> Array:
        w, r, c = shape
        return np.concatenate([
            opened(u + w, r, c) - worn(u - 5e-3), opened(w - u, r, c) - worn(-u - 5e-3)
        ])  # fmt: skip

    effect = UnderlapLeakage("joint 2")
    lows, highs = zip(*((s.low, s.high) for s in effect.shapes(rig)), strict=True)
    start, scale = (0.0, 0.02, 1.0), (0.01, 0.02, 1.0)
    free = least_squares(misfit, start, bounds=(lows, highs), x_scale=scale)
    above = least_squares(misfit, start, bounds=((-1e-12, *lows[1:]), highs), x_scale=scale)
    assert free.x[0] == pytest.approx(-5e-3, abs=1e-3)
    assert free.cost < 0.1 * above.cost
    values = dict.fromkeys((c.parameter for c in effect.coefficients(rig)), 1e-8)
    assert effect.problem(rig, values, free.x.tolist()) == ""
    assert effect.inseparable(free.x.tolist()) == (("valve_deadband", "joint 2"),)
    assert effect.inseparable((1e-3, 0.02, 1.0)) == effect.inseparable() == ()
    # Sharper corners close, and then the valve has a dead band.
    assert "that is a dead band" in effect.problem(rig, values, (-5e-3, 4e-3, 0.0))


@pytest.mark.parametrize("kind", [ValveDeadband, UnderlapLeakage])
def test_a_shape_without_a_corner_is_that_of_clearance(
    rig: Rig, kind: type[ValveDeadband] | type[UnderlapLeakage]
) -> None:
    effect = kind("joint 2")
    plain = [s.middle for s in effect.shapes(rig) if not s.detail]
    values = dict.fromkeys(gain_names(2), 1.0)
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
