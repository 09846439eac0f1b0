"""Known waveforms give known dots; whatever the numbers, no spike is lost and no gap is filled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rig.tui.drawing.braille import (
    DASH,
    Scale,
    curve_dots,
    decimate,
    level_dots,
    scale_around,
    to_cells,
    to_text,
)

UNIT = Scale(0.0, 1.0)
# Braille dots are numbered 1 2 3 down the left and 4 5 6 down the right, 7 and 8 below them.
NUMBERED = {1: (0, 0), 2: (1, 0), 3: (2, 0), 4: (0, 1), 5: (1, 1), 6: (2, 1), 7: (3, 0), 8: (3, 1)}


def decoded(lines: list[str]) -> np.ndarray:
    """Return the dots of braille text, by the standard's numbering and not by our bit table."""
    found = np.zeros((4 * len(lines), 2 * len(lines[0])), dtype=bool)
    for y, line in enumerate(lines):
        for x, character in enumerate(line):
            for number, (row, column) in NUMBERED.items():
                if (ord(character) - 0x2800) >> (number - 1) & 1:
                    found[4 * y + row, 2 * x + column] = True
    return found


def line_of(
    values: list[float], height: int = 1, limits: tuple[float | None, ...] = ()
) -> list[str]:
    array = np.array(values)
    levels = [
        level_dots(level, len(array), 4 * height, UNIT) for level in limits if level is not None
    ]
    return to_text(np.logical_or.reduce([curve_dots(array, array, 4 * height, UNIT), *levels]))


def test_a_constant_is_a_level_line() -> None:
    assert line_of([1.0] * 6) == ["⠉⠉⠉"]
    assert line_of([0.0] * 6) == ["⣀⣀⣀"]


def test_a_ramp_climbs_from_the_lower_left_to_the_upper_right() -> None:
    assert line_of([0.0, 1 / 3, 2 / 3, 1.0]) == ["⡠⠊"]
    assert line_of([1.0, 2 / 3, 1 / 3, 0.0]) == ["⠑⢄"]


def test_a_square_wave_is_joined_by_upright_strokes() -> None:
    assert line_of([0.0, 0.0, 1.0, 1.0, 0.0, 0.0]) == ["⣀⠏⣆"]


def test_nan_is_a_gap_and_is_not_joined_across() -> None:
    nan = float("nan")
    assert line_of([1.0, 1.0, nan, nan, 0.0, 0.0]) == ["⠉⠀⣀"]
    assert line_of([nan] * 4) == ["⠀⠀"]


def test_limits_are_dashed_lines_where_they_belong() -> None:
    nan = float("nan")
    lines = line_of([nan] * 8, 2, (0.0, 1.0))
    dots = decoded(lines)
    assert dots[0].tolist() == dots[-1].tolist() == [i % DASH == 0 for i in range(8)]
    assert not dots[1:-1].any()
    assert line_of([nan] * 4, 1, (None, 7.0)) == ["⠀⠀"], "a limit off the scale is not drawn"


def test_a_single_spike_among_many_samples_is_drawn() -> None:
    time = np.arange(1, 10001) / 1000
    values = np.full(10000, 0.5)
    values[6543] = 1.0
    low, high = decimate(time, values, values, 0.0, 10.0, 40)
    dots = curve_dots(low, high, 8, UNIT)
    assert dots[0].sum() == 1
    assert dots[0, int(6.544 / 10 * 40)]


def test_buckets_wider_than_a_column_fill_their_columns_but_not_a_gap() -> None:
    nan = float("nan")
    time = np.array([1.0, 2.0, 3.0, 4.0])
    values = np.array([0.1, 0.2, nan, 0.4])
    low, _ = decimate(time, values, values, 1.0, 5.0, 16)
    assert np.allclose(low[0:4], 0.2, atol=0.11)
    assert np.isnan(low[5:7]).all(), "nothing was measured from 2 s to 3 s"
    assert np.allclose(low[9:12], 0.4)
    assert np.isnan(low[13:]).all(), "nothing is known of the time to come"


def test_no_time_and_no_buckets_give_an_empty_plot() -> None:
    nothing = np.empty(0)
    for start, stop, columns in ((0.0, 1.0, 4), (1.0, 1.0, 4), (0.0, 1.0, 0)):
        low, high = decimate(nothing, nothing, nothing, start, stop, columns)
        assert len(low) == len(high) == columns
        assert np.isnan(low).all()


def test_dots_that_do_not_fill_characters_are_refused() -> None:
    with pytest.raises(ValueError, match="5 x 2 dots"):
        to_text(np.zeros((5, 2), dtype=bool))


@given(st.integers(1, 30), st.integers(0, 60), st.data())
def test_text_holds_the_very_dots_it_was_made_of(
    height: int, width: int, data: st.DataObject
) -> None:
    dots = data.draw(arrays(bool, (4 * height, 2 * width)))
    lines = to_text(dots)
    assert len(lines) == height
    assert {len(line) for line in lines} == {width}
    if width:
        assert (decoded(lines) == dots).all()
        blank = np.array([[c == "⠀" for c in line] for line in lines])
        assert (to_cells(dots) == ~blank).all()


finite = st.floats(-1e9, 1e9)


@given(
    st.lists(st.tuples(finite, finite) | st.none(), max_size=40).filter(lambda v: len(v) % 2 == 0),
    st.integers(1, 12),
)
def test_every_measured_column_shows_its_range_and_every_gap_stays_empty(
    columns: list[tuple[float, float] | None], height: int
) -> None:
    nan = (float("nan"),) * 2
    pairs = np.array([sorted(c) if c else nan for c in columns]).reshape(-1, 2)
    scale = scale_around(pairs.ravel().tolist())
    dots = curve_dots(pairs[:, 0], pairs[:, 1], 4 * height, scale)
    for x, (low, high) in enumerate(pairs):
        if np.isnan(low):
            assert not dots[:, x].any()
            continue
        top, bottom = int(scale.row(high, 4 * height)), int(scale.row(low, 4 * height))
        assert dots[top : bottom + 1, x].all()
        rows = np.flatnonzero(dots[:, x])
        assert (np.diff(rows) == 1).all(), "a column is one upright stroke"
        if x and not np.isnan(pairs[x - 1, 0]):
            before = np.flatnonzero(dots[:, x - 1])
            assert rows[0] <= before[-1] + 1, "neighbours touch"
            assert rows[-1] >= before[0] - 1, "neighbours touch"


@given(
    arrays(float, st.integers(1, 200), elements=st.floats(-10, 10)),
    st.integers(1, 50),
    st.floats(0.01, 100),
)
def test_decimating_keeps_the_extremes_and_invents_nothing(
    values: np.ndarray, columns: int, span: float
) -> None:
    n = len(values)
    time = np.arange(1, n + 1) * (span / n)
    low, high = decimate(time, values, values, 0.0, float(time[-1]), columns)
    assert np.nanmin(low) == values.min()
    assert np.nanmax(high) == values.max()
    assert np.isin(low[~np.isnan(low)], values).all()
    # Column by column against the plain definition, where a bucket ends in the column.
    width = time[-1] / columns
    of = np.minimum((time / width).astype(int), columns - 1)
    for column in np.unique(of):
        assert low[column] == values[of == column].min()
        assert high[column] == values[of == column].max()


@given(st.lists(st.none() | st.just(float("nan")) | st.floats(-1e300, 1e300), max_size=8))
def test_a_scale_is_never_empty_and_holds_what_it_was_made_for(values: list[float | None]) -> None:
    scale = scale_around(values)
    assert scale.low < scale.high
    for value in values:
        if value is not None and np.isfinite(value):
            assert scale.low <= value <= scale.high
