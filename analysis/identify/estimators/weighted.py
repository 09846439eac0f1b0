"""Least squares weighted by measured noise: the scatter of the residuals between repeats.

The flow rows of the two chambers of one joint share the noise of its piston, with opposite sign;
their 2 x 2 covariance is measured too, and both are whitened together (generalised least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.estimators.equations import (
    EquationFit,
    RepeatBlock,
    least_squares,
    over_repeats,
    with_common_rows,
)
from analysis.identify.settings import IDENTIFY
from rig.model.parse import InputError

Array = NDArray[np.float64]


def weighted_least_squares(blocks: Sequence[RepeatBlock]) -> EquationFit:
    """Solve with weights 1 / sigma^2 of each step's equation; blocks need repeats."""
    blocks = with_common_rows(blocks)
    fit = least_squares(blocks)
    for _ in range(IDENTIFY.weight_rounds):
        fit = least_squares(_whitened(blocks, fit.beta))
    return fit


def _whitened(blocks: Sequence[RepeatBlock], beta: Array) -> list[RepeatBlock]:
    """Return the blocks with unit noise, those of a pair of chambers mixed by inv(cholesky).

    The noise is that of y - X beta. With n repeats the deviations from their mean are
    sqrt((n-1)/n) of it; this is corrected.
    """
    residuals = [b.y - b.X @ beta for b in blocks]
    deviation = [
        (e - total / n) * np.sqrt(n / max(n - 1, 1))
        for e, (total, n) in zip(residuals, over_repeats(blocks, residuals), strict=True)
    ]
    index_of = {(b.run, b.record, b.equation): i for i, b in enumerate(blocks)}

    def with_other_chamber(i: int) -> list[int]:
        """Return a block's index, and that of the other chamber where that has the same rows."""
        kind, joint = blocks[i].equation.rsplit("_", 1)
        other = {"flow_cap": "flow_rod", "flow_rod": "flow_cap"}.get(kind)
        k = index_of.get((blocks[i].run, blocks[i].record, f"{other}_{joint}"))
        return [i] if k is None or len(blocks[k].y) != len(blocks[i].y) else [i, k]

    pairs = [with_other_chamber(i) for i in range(len(blocks))]
    factors: dict[tuple[tuple[int, str, str], int], Array] = {}
    out = list(blocks)
    for b, pair in zip(blocks, pairs, strict=True):
        if len(pair) > 1 and b.equation.startswith("flow_rod"):
            continue  # mixed with its cap chamber
        key = b.shared, len(pair)
        if key not in factors:
            # A repeat may lack the other chamber: one of its pressures is masked throughout.
            stacked = [
                np.column_stack([deviation[k] for k in repeat[: len(pair)]])
                for c, repeat in zip(blocks, pairs, strict=True)
                if c.shared == b.shared and len(repeat) >= len(pair)
            ]
            factors[key] = _whitener(np.concatenate(stacked), b)
        L = factors[key]
        for row, target in enumerate(pair):
            X = sum(L[row, c] * blocks[j].X for c, j in enumerate(pair))
            y = sum(L[row, c] * blocks[j].y for c, j in enumerate(pair))
            out[target] = replace(blocks[target], X=np.asarray(X), y=np.asarray(y))
    return out


def _whitener(deviation: Array, b: RepeatBlock) -> Array:
    """Return inv(cholesky(covariance)) of deviations (rows, equations of the pair)."""
    covariance = deviation.T @ deviation / len(deviation)
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    except np.linalg.LinAlgError:
        raise InputError(
            f"--estimator wls weighs by the scatter between repeats, but the repeats of "
            f"{b.step!r} do not differ in {b.equation}: are they copies of one record?"
        ) from None
