"""Solve with a robust loss: rows far outside the scatter of the rest lose their weight.

Iteratively reweighted least squares with Huber's loss to a start, then Tukey's biweight, scale by
the median absolute residual of each step's equation. A spike in a channel also makes large entries
in the columns (above all in a second derivative), and such rows pull least squares. Where a step
has three repeats or more, rows far from the repeats' median get a smaller weight beforehand
(Mallows). Source: Maronna, Martin, Yohai and Salibian-Barrera, Robust Statistics, 2nd ed. (2019),
sections 4.4 and 5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.estimators.equations import EquationFit, RepeatBlock, groups, least_squares
from analysis.identify.settings import IDENTIFY

Array = NDArray[np.float64]


def robust(blocks: Sequence[RepeatBlock]) -> EquationFit:
    """Solve with weights that fall for outlying rows."""
    initial = leverage_weights(blocks)
    fit = least_squares(blocks, initial)
    for loss in (_huber, _tukey):
        for _ in range(IDENTIFY.robust_rounds):
            scales = _scales(blocks, fit.residuals(), initial)
            weights = [
                start * loss(e / s)
                for start, e, s in zip(initial, fit.residuals(), scales, strict=True)
            ]
            previous, fit = fit.beta, least_squares(blocks, weights)
            if np.all(np.abs(fit.beta - previous) <= IDENTIFY.robust_settled * np.abs(fit.beta)):
                break
    return fit


def outlier_statement(family: str, fit: EquationFit) -> Check:
    """State the share of rows that have lost nine tenths of their weight, in the worst record."""
    lost: dict[tuple[int, str], list[float]] = {}
    for b, w in zip(fit.blocks, fit.w, strict=True):
        lost.setdefault((b.run, b.record), []).append(float(np.mean(w < 0.1)))
    shares = {place: float(np.mean(of_equations)) for place, of_equations in lost.items()}
    (_, record), share = max(shares.items(), key=lambda item: item[1])
    return Check(
        f"outliers {family}",
        share < IDENTIFY.few_outliers,
        f"{100 * share:.2g} % of the rows of record {record!r} lie far outside the scatter and "
        "were left out (the worst record)",
    )


def _huber(r: Array) -> Array:
    return np.asarray(np.minimum(1.0, IDENTIFY.huber / np.maximum(np.abs(r), 1e-300)))


def _tukey(r: Array) -> Array:
    return np.asarray(
        np.where(np.abs(r) < IDENTIFY.tukey, (1.0 - (r / IDENTIFY.tukey) ** 2) ** 2, 0.0)
    )


def _scales(
    blocks: Sequence[RepeatBlock], residuals: Sequence[Array], weights: Sequence[Array]
) -> list[float]:
    scale = {}
    for key, indices in groups(blocks).items():
        deviations = [np.abs(residuals[k][weights[k] > 0.5]) for k in indices]
        median = float(np.median(np.concatenate(deviations)))
        scale[key] = max(IDENTIFY.mad_to_std * median, 1e-300)
    return [scale[b.shared] for b in blocks]


def leverage_weights(blocks: Sequence[RepeatBlock]) -> list[Array]:
    """Return weights (m,) of each block's rows, below 1 far from the median of the repeats."""
    out = [np.ones(len(b.y)) for b in blocks]
    for members in groups(blocks).values():
        if len(members) < IDENTIFY.least_repeats:
            continue
        times = np.unique(np.concatenate([blocks[i].ticks for i in members]))
        width = blocks[members[0]].X.shape[1] + 1
        stack = np.full((len(members), len(times), width), np.nan)
        tick_indices = [np.searchsorted(times, blocks[i].ticks) for i in members]
        for n, (i, at) in enumerate(zip(members, tick_indices, strict=True)):
            stack[n, at] = np.column_stack((blocks[i].X, blocks[i].y))
        distances = np.abs(stack - np.nanmedian(stack, axis=0))
        # Repeats differ slightly throughout (drift, trim): scale by the record's own median
        # distance.
        typical = IDENTIFY.mad_to_std * np.nanmedian(distances, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.nanmax(np.where(typical > 0, distances / typical, 0.0), axis=2)
        for n, (i, at) in enumerate(zip(members, tick_indices, strict=True)):
            out[i] = (
                IDENTIFY.leverage_limit / np.maximum(distance[n, at], IDENTIFY.leverage_limit)
            ) ** 4
    return out
