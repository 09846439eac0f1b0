"""Uneven samples on the even grid: against numpy.interp, a known signal, and with gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.model.wire.resample import LONGEST, Resampler, Row

CLEAR = np.zeros(2, dtype=np.bool_)


def resampled(times: np.ndarray, values: np.ndarray) -> tuple[list[Row], Resampler]:
    resampler = Resampler()
    rows: list[Row] = []
    for at, value in zip(times, values, strict=True):
        rows += resampler.add(float(at), value, CLEAR)
    return rows, resampler


@given(
    st.floats(0.0, 1e6),
    st.lists(st.floats(0.01, 4.0), min_size=2, max_size=60),
    st.integers(0, 2**32 - 1),
)
def test_every_tick_is_as_numpy_interpolates_or_counted_missing(
    first: float, steps: list[float], seed: int
) -> None:
    times = first + np.concatenate([[0.0], np.cumsum(steps)])
    values = np.random.default_rng(seed).normal(size=(len(times), 2))
    rows, resampler = resampled(times, values)
    ticks = [row.tick for row in rows]
    assert ticks == sorted(set(ticks))
    for row in rows:
        expected = [np.interp(row.tick, times, column) for column in values.T]
        assert row.values == pytest.approx(expected, abs=1e-3)
        after = int(np.searchsorted(times, row.tick))
        near = min(abs(times - row.tick)) <= 2e-6
        assert near or times[after] - times[after - 1] <= LONGEST
    # Every tick between the first row and the last sample is a row or missing.
    inside = list(range(int(np.ceil(times[0] - 2e-6)), int(np.floor(times[-1] + 2e-6)) + 1))
    doubtful = sum(min(abs(times - t)) <= 2e-6 for t in inside)
    assert abs(len(inside) - len(rows) - resampler.missing) <= doubtful


def test_a_sine_read_with_jitter_is_as_near_as_linear_interpolation_allows() -> None:
    rng = np.random.default_rng(7)
    times = np.arange(400) + rng.uniform(0.0, 0.5, 400)
    omega = 2 * np.pi / 50.0
    rows, resampler = resampled(times, np.column_stack([np.sin(omega * times)] * 2))
    assert resampler.missing == 0
    assert [row.tick for row in rows] == list(range(1, 400))
    found = np.array([row.values[0] for row in rows])
    error = np.abs(found - np.sin(omega * np.arange(1, 400)))
    assert error.max() <= (omega * LONGEST) ** 2 / 8
    # Taking each sample for its tick's value would be much worse.
    assert error.max() < 0.3 * np.abs(np.sin(omega * times) - np.sin(omega * np.arange(400))).max()


def test_one_period_and_a_half_apart_is_interpolated_and_more_is_a_gap() -> None:
    one, two = np.array([1.0, 0.0]), np.array([4.0, 3.0])
    near = Resampler()
    assert near.add(10.25, one, CLEAR) == []
    (row,) = near.add(11.75, two, CLEAR)
    assert (row.tick, near.missing) == (11, 0)
    assert row.values == pytest.approx([2.5, 1.5])
    far = Resampler()
    far.add(10.25, one, CLEAR)
    assert far.add(11.76, two, CLEAR) == []
    assert far.missing == 1
    (row,) = far.add(12.5, one, CLEAR)
    assert row.tick == 12


def test_a_sample_exactly_at_its_tick_is_taken_as_it_is_even_after_a_gap() -> None:
    resampler = Resampler()
    value = np.array([1.0, 2.0])
    assert [row.tick for row in resampler.add(5.0, value, CLEAR)] == [5]
    rows = resampler.add(9.0 + 1e-9, 2 * value, CLEAR)
    assert [(row.tick, *row.values) for row in rows] == [(9, 2.0, 4.0)]
    assert resampler.missing == 3


def test_a_row_is_saturated_where_a_sample_it_rests_on_was() -> None:
    resampler = Resampler()
    mark = np.array([True, False])
    resampler.add(0.5, np.zeros(2), mark)
    (between,) = resampler.add(1.25, np.zeros(2), ~mark)
    (after,) = resampler.add(2.0, np.zeros(2), CLEAR)
    assert between.saturated.tolist() == [True, True]
    assert after.saturated.tolist() == [False, False]


def test_a_number_that_is_none_stays_none_and_spoils_no_other_channel() -> None:
    resampler = Resampler()
    resampler.add(0.5, np.array([np.inf, 1.0]), CLEAR)
    (row,) = resampler.add(1.5, np.array([np.inf, 1.0]), CLEAR)
    assert not np.isfinite(row.values[0])
    assert row.values[1] == 1.0


def test_time_that_goes_back_is_refused_and_a_restart_forgets() -> None:
    resampler = Resampler()
    resampler.add(5.5, np.zeros(2), CLEAR)
    with pytest.raises(ValueError, match=r"follows one at 5.5"):
        resampler.add(5.5, np.zeros(2), CLEAR)
    resampler.restart()
    resampler.add(90.5, np.zeros(2), CLEAR)
    assert resampler.missing == 0
