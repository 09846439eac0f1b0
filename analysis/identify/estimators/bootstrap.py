"""Block bootstrap: whole repeats are drawn with replacement, step by step, and solved again.

Residuals within a record are correlated, so single rows must not be drawn; whole repeats are
independent. For a step with one repeat, parts of its period are drawn instead. n repeats drawn with
replacement scatter by sqrt((n-1)/n) too little; deviations are scaled up by that factor and by the
ratio of Student's t to the normal quantile.

Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), sections 3.2, 8.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from analysis.identify.estimators.equations import RepeatBlock, rows_of

Array = NDArray[np.float64]
Units = dict[tuple[int, str], list[tuple[int, int]]]  # by (run, step): (repeat, part or -1)


def bootstrap(
    blocks: Sequence[RepeatBlock],
    estimate: Callable[[Sequence[RepeatBlock]], Array],
    draws: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return the ends (k,) of the 95 % intervals of `estimate`, from `draws` sets of blocks."""
    value, units = estimate(blocks), _units(blocks)
    drawn = np.array([estimate(_resampled(blocks, units, rng)) for _ in range(draws)])
    counts = [len(members) for members in units.values()]
    n = min(counts)
    stretch = np.sqrt(n / max(n - 1, 1))
    if n > 1:
        stretch *= stdtrit(sum(counts) - len(counts), 0.975) / ndtri(0.975)
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0) - value
    return value + stretch * low, value + stretch * high


def _units(blocks: Sequence[RepeatBlock]) -> Units:
    """Return the units to draw in each stratum: (repeat, -1), or (only repeat, part)."""
    out: Units = {}
    for stratum in dict.fromkeys(b.stratum for b in blocks):
        members = [b for b in blocks if b.stratum == stratum]
        repeats = sorted({b.repeat for b in members})
        if len(repeats) > 1:
            out[stratum] = [(repeat, -1) for repeat in repeats]
        else:
            parts = np.unique(np.concatenate([b.segment for b in members]))
            out[stratum] = [(repeats[0], part) for part in parts.tolist()]
    return out


def _resampled(
    blocks: Sequence[RepeatBlock], units: Units, rng: np.random.Generator
) -> list[RepeatBlock]:
    out = []
    for stratum, members in units.items():
        for copy, pick in enumerate(rng.integers(0, len(members), len(members))):
            repeat, part = members[int(pick)]
            for b in blocks:
                if b.stratum == stratum and b.repeat == repeat:
                    out.append(_piece(b, part, copy))
    return out


def _piece(b: RepeatBlock, part: int, copy: int) -> RepeatBlock:
    # A repeat drawn twice counts as two.
    named = replace(b, repeat=copy, record=f"{b.record}#{copy}")
    return named if part < 0 else rows_of(named, b.segment == part)
