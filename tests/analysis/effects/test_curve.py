"""Curves that the data draw: scipy's spline inside, a straight line outside, the same compiled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from analysis.effects.curve import (
    curve_at,
    knot_values,
    packed,
    shortest_wave,
    spline,
    spread_knots,
)


@given(
    st.lists(st.floats(0.05, 1.0), min_size=2, max_size=6),
    st.lists(st.floats(-5.0, 5.0), min_size=7, max_size=7),
)
def test_the_curve_is_a_not_a_knot_spline_with_straight_ends(
    steps: list[float], values: list[float]
) -> None:
    knots = np.cumsum([0.3, *steps])
    y = np.array(values[: len(knots)])
    inner, other = np.linspace(knots[0], knots[-1], 57), CubicSpline(knots, y)
    scale = 1.0 + np.abs(other(inner)).max()
    assert spline(knots, inner) @ y == pytest.approx(other(inner), abs=1e-9 * scale)
    for end, at in ((knots[0], knots[0] - 0.7), (knots[-1], knots[-1] + 0.7)):
        line = other(end) + other(end, 1) * (at - end)
        assert (spline(knots, np.array([at])) @ y)[0] == pytest.approx(line, abs=1e-8 * scale)
    par = np.concatenate(([9.0], packed(knots, y)))
    everywhere = np.linspace(knots[0] - 1.0, knots[-1] + 1.0, 23)
    compiled = [curve_at(x, par, 1, len(knots)) for x in everywhere]
    assert compiled == pytest.approx(spline(knots, everywhere) @ y, abs=1e-8 * scale)


def test_a_gauge_takes_one_freedom_and_no_other() -> None:
    knots = np.array([0.0, 0.2, 0.5, 0.9, 1.0, 1.4])
    gauge = shortest_wave(knots)
    ways = knot_values(gauge)
    assert np.linalg.matrix_rank(ways) == 5
    assert gauge @ ways == pytest.approx(np.zeros(5), abs=1e-12)
    assert gauge @ knots**4 == pytest.approx(0.0, abs=1e-9)  # a polynomial stays as it is
    assert abs(gauge @ knots**5) > 1e-3


def test_knots_stand_where_the_data_are_and_never_on_one_another() -> None:
    values = np.concatenate((np.zeros(900), np.linspace(0, 1, 100)))
    knots = spread_knots(values, (0.0, 0.3, 0.6, 1.0), low=0.0)
    assert np.all(np.diff(knots) >= 0.0199)
    assert len(spread_knots(np.full(10, 2.0), (0.0, 0.5, 1.0))) == 0
    assert len(spread_knots(np.zeros(0), (0.0, 0.5, 1.0))) == 0
