"""What the screen remembers of a run: every extreme, no more than it measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rig.tui.following.history import History, regroup
from tests.tui.recorded import RATE, Bench, run, samples, snapshot

BENCH = Bench()


def test_what_is_remembered_has_the_extremes_of_what_was_measured() -> None:
    history = History()
    for view in run(BENCH, 3.0):
        history.add(view)
    window = history.window(2.0)
    time = np.arange(0, round(3.0 * RATE)) / RATE
    truth = np.concatenate(
        [samples(BENCH, time[k : k + 50])["cap_pressure_2"] for k in range(0, len(time), 50)]
    )
    recent = truth[time >= 1.0]
    span = window.span("cap_pressure_2", 1.0)
    assert span == pytest.approx((recent.min(), recent.max()))
    assert window.time[-1] == pytest.approx(3.0)
    assert (np.diff(window.time) > 0).all()


def test_the_ring_forgets_the_oldest_and_keeps_the_order() -> None:
    history = History(capacity=100)
    for view in run(BENCH, 5.0):
        history.add(view)
    window = history.window(1e9)
    assert len(window.time) == 100
    assert (np.diff(window.time) > 0).all()
    assert window.time[-1] == pytest.approx(5.0)


def test_a_window_is_a_copy_that_nobody_can_change() -> None:
    history = History()
    history.add(snapshot(BENCH, 1))
    window = history.window(10.0)
    before = window.low.copy()
    with pytest.raises(ValueError, match="read-only"):
        window.low[0, 0] = 0.0
    history.add(snapshot(BENCH, 2))
    assert np.array_equal(window.low, before)


def test_after_a_gap_nothing_is_drawn_where_nothing_arrived() -> None:
    history = History()
    for k in range(1, 21):
        history.add(snapshot(BENCH, k))
    history.add(snapshot(BENCH, 60), after_gap=True)
    window = history.window(10.0)
    low, _ = window.of("piston_1")
    assert np.isnan(low[-2]), "the stretch from 1 s to 3 s"
    assert window.time[-3] == pytest.approx(1.0)
    assert np.isfinite(low[-1])


def test_a_new_run_starts_with_an_empty_memory() -> None:
    history = History()
    for k in range(1, 21):
        history.add(snapshot(BENCH, k))
    history.add(snapshot(replace(BENCH, run="another"), 400))
    assert len(history.window(1e9).time) == 1
    history.add(snapshot(replace(BENCH, run="another"), 10))  # the device's clock was reset
    assert history.window(1e9).time.tolist() == [pytest.approx(0.5)]


def test_a_snapshot_without_samples_adds_nothing() -> None:
    history = History()
    history.add(snapshot(BENCH, 1))
    history.add(snapshot(BENCH, 1))
    assert len(history.window(1e9).time) == 1


def test_the_stroke_is_remembered_when_a_lock_narrows_the_limits() -> None:
    history = History()
    history.add(snapshot(BENCH, 1))
    view = snapshot(BENCH, 2)
    locked = replace(view.channels["piston_1"], low=-0.038, high=-0.036)
    history.add(replace(view, channels={**view.channels, "piston_1": locked}))
    assert history.window(1.0).reach["piston_1"] == (-0.039, 0.039)


def test_an_unknown_channel_is_nothing_but_gaps() -> None:
    history = History()
    history.add(snapshot(BENCH, 1))
    window = history.window(1.0)
    assert np.isnan(window.of("nothing")[0]).all()
    assert window.span("nothing", 0.0) is None


@given(arrays(float, st.integers(0, 60), elements=st.floats(-1e9, 1e9)), st.integers(1, 40))
def test_regrouping_keeps_extremes_for_any_number_of_buckets(
    values: np.ndarray, count: int
) -> None:
    low, high = regroup(values - 1.0, values + 1.0, count)
    assert len(low) == len(high) == count
    if not len(values):
        assert np.isnan(low).all()
        assert np.isnan(high).all()
    else:
        assert low.min() == (values - 1.0).min()
        assert high.max() == (values + 1.0).max()
        assert (low <= high).all()
