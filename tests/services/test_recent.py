"""The latest samples, kept in one piece of memory while blocks of any length come in."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rig.bench.checks.recent import Recent

KEEP = 7


@given(st.lists(st.integers(1, 60), max_size=40), st.integers(0, KEEP))
def test_what_is_kept_are_the_latest_rows_wherever_blocks_are_cut(
    lengths: list[int], count: int
) -> None:
    rng = np.random.default_rng(0)
    recent, every = Recent(3, KEEP), np.empty((0, 3))
    for length in lengths:
        block = rng.normal(size=(length, 3))
        recent.add(block)
        every = np.concatenate((every, block))
        # The block that came last is there besides those to keep.
        newest = every[max(0, len(every) - length - count) :]
        np.testing.assert_array_equal(recent.last(length + count), newest)
    recent.forget()
    assert len(recent.last(KEEP)) == 0
