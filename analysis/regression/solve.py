"""Coupled least squares by QR of clusters of rows: only their triangles R are kept.

The rows of all records are stacked and solved once, so that a parameter that appears in several
steps has one value (Sakai and Maeshima's STEP4). Each cluster of rows is reduced to
the triangle R of [X y] = Q R, (k+1, k+1); triangles merge by another QR, and everything below
(solution, condition number, residual, clustered errors) needs triangles only.

Standard errors are clustered by repeat: within one record residuals are correlated, so only whole
repeats are independent. Steps are strata: the scores g = X'(y - X beta) of the repeats of a step
are taken about their mean: an error of the model, equal in every repeat, does not count as scatter.
 V = A^-1 [ sum_steps n/(n-1) sum_r (g_r - mean g)(g_r - mean g)' ] A^-1,  A = X'X,
and a parameter's t quantile has Satterthwaite's degrees of freedom over the steps (n - 1 each).
Source: Liang and Zeger (1986) in its stratified form (Cochran, Sampling Techniques, ch. 11).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.special import stdtrit

from analysis.regression.least_squares import Array, factored
from analysis.regression.settings import REGRESSION

MOSTLY_NOISE: Final = "its column in these records is mostly sensor noise"
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class RowCluster:
    """Reduced rows of an independent cluster: a repeat, or a segment of the only repeat.

    Clusters with the same stratum and key are parts of one.
    """

    stratum: Hashable
    key: Hashable
    triangle: Array
    rows: int


@dataclass(frozen=True)
class Solution:
    """A solved family of rows: `value` and `covariance` of the rows' own coefficients.

    Entries of parameters in `unidentifiable` (name -> why) are NaN. `condition_number` is of the
    column-scaled matrix, over all columns that are not zero. `residual_rms` has the rows' unit.
    `noise_bias` is the bias that the stated sensor noise predicts, NaN where not requested.
    `triangle` (k+1, k+1) of all rows and `noise`, as passed (empty if not), are kept for
    `analysis.regression.identifiability`.
    """

    names: tuple[str, ...]
    value: Array
    covariance: Array
    dof: Array
    condition_number: float
    rows: int
    residual_rms: float
    noise_bias: Array
    unidentifiable: dict[str, str] = field(default_factory=dict)
    triangle: Array = field(default_factory=lambda: np.zeros((0, 0)))
    noise: Array = field(default_factory=lambda: np.zeros((0, 0)))


def triangle(matrix: Array, rhs: Array) -> Array:
    """Return R (k+1, k+1) of [X y] = Q R for rows (m, k), (m,)."""
    return square(np.column_stack((matrix, rhs)))


def merge(triangles: Iterable[Array]) -> Array:
    """Return the triangle of all rows represented by the triangles, (k+1, k+1)."""
    return square(np.vstack(list(triangles)))


def square(stacked: Array) -> Array:
    """Return the triangle R (k, k) of stacked = Q R, (m, k), filled with zeros where m < k."""
    width = stacked.shape[1]
    R: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
    return np.vstack((R, np.zeros((width - len(R), width)))) if len(R) < width else R


class Accumulator:
    """The triangle of all rows added so far, in the memory of one block of them.

    [X y] = Q R block by block: the previous triangle on top of the next rows, one Householder QR,
    and only R (k+1, k+1) is kept (a sequential TSQR: Golub and Van Loan, section 5.1.9 and the flat
    tree of Demmel et al. 2012). Every block is small enough for the processor's cache, which is why
    this is faster than one QR of all rows.
    """

    def __init__(self, columns: int, block_rows: int = REGRESSION.block_rows) -> None:
        self.rows = 0
        self._width = columns + 1
        self._block = max(block_rows, self._width)
        self._R = np.zeros((self._width, self._width))
        self._space: Array | None = None

    @property
    def triangle(self) -> Array:
        """R (k+1, k+1), upper triangular, with R'R = [X y]'[X y]."""
        return self._R.copy()

    def fold(self, matrix: Array, rhs: Array) -> None:
        """Add rows (m, k), (m,); raises ValueError for other shapes."""
        if matrix.shape != (len(rhs), self._width - 1):
            raise ValueError(f"rows {matrix.shape}, {rhs.shape}: need {self._width - 1} columns")
        for start in range(0, len(rhs), self._block):
            block = slice(start, start + self._block)
            count = len(rhs[block])
            space = self._stack(count)
            space[self._width :, :-1] = matrix[block]
            space[self._width :, -1] = rhs[block]
            self._reduce(space)
        self.rows += len(rhs)

    def merge(self, triangle: Array, rows: int) -> None:
        """Add the triangle of another accumulator (or a part of it) that represents `rows` rows."""
        space = self._stack(len(triangle))
        space[self._width :] = triangle
        self._reduce(space)
        self.rows += rows

    def fade(self, factor: float) -> None:
        """Multiply R'R of all rows added so far by `factor` (exponential forgetting)."""
        self._R *= np.sqrt(factor)

    def _stack(self, count: int) -> Array:
        """Return an array (k+1 + count, k+1) in LAPACK's order with the triangle on top."""
        if count != self._block:
            space = np.empty((self._width + count, self._width), order="F")
        else:
            if self._space is None:
                self._space = np.empty((self._width + count, self._width), order="F")
            space = self._space
        space[: self._width] = self._R
        return space

    def _reduce(self, space: Array) -> None:
        packed, _, _, info = lapack.dgeqrf(space, overwrite_a=1)
        if info != 0:
            raise ValueError(f"LAPACK refused the rows (dgeqrf: {info})")
        self._R = np.triu(packed[: self._width])


def solve(
    names: Sequence[str],
    clusters: Sequence[RowCluster],
    noise: Array | None = None,
    reject_noise: bool = True,
    scatter: Sequence[RowCluster] | None = None,
) -> Solution:
    """Solve all clusters at once; parameters that the rows do not determine are NaN.

    `noise` (k+1, k+1) is the part of [X y]'[X y] that sensor noise makes
    (`analysis.regression.noise`); with `reject_noise` a parameter determined mostly by it counts as
    undetermined. The errors come from the clusters `scatter`, where those are others
    (`analysis.identify.streams.online`).
    """
    k = len(names)
    R = merge(c.triangle for c in clusters)
    X, y = R[:k, :k], R[:k, k]
    inverse, condition, undetermined = _pseudo_inverse(names, X)
    beta, bread = inverse @ y, inverse @ inverse.T
    covariance, dof = _clustered(beta, bread, clusters if scatter is None else scatter)
    noise_bias = np.full(k, np.nan)
    if noise is not None:
        noise_bias = -bread @ (noise[:k, :k] @ beta - noise[:k, k])
        shares = np.diag(bread @ noise[:k, :k])
        for name, share in zip(names, shares, strict=True):
            if reject_noise and share > REGRESSION.noise_share:
                undetermined.setdefault(name, MOSTLY_NOISE)
    rows = sum(c.rows for c in clusters)
    squares = np.sum((y - X @ beta) ** 2) + R[k, k] ** 2
    residual_rms = float(np.sqrt(squares / max(rows, 1)))
    missing = np.array([name in undetermined for name in names])
    beta[missing] = dof[missing] = np.nan
    covariance[missing, :] = covariance[:, missing] = np.nan
    return Solution(
        tuple(names), beta, covariance, dof, condition, rows, residual_rms, noise_bias,
        undetermined, R, np.zeros((0, 0)) if noise is None or not reject_noise else noise,
    )  # fmt: skip


def _pseudo_inverse(names: Sequence[str], X: Array) -> tuple[Array, float, dict[str, str]]:
    """Return the inverse of X (k, k), its condition number with unit columns, and reasons.

    The reasons state, by name, why a parameter is undetermined. Columns of zeros, and directions
    below the rank tolerance, are left out of the inverse.
    """
    filled = np.flatnonzero(np.any(X != 0.0, axis=0))
    reasons = {n: "no row contains it" for i, n in enumerate(names) if i not in filled}
    inverse = np.zeros_like(X)
    if not len(filled):
        return inverse, float("inf"), reasons
    factors = factored(X[:, filled])
    reasons |= _confounded([names[int(i)] for i in filled], factors.null)
    inverse[filled] = factors.inverse
    return inverse, factors.condition, reasons


def _confounded(names: Sequence[str], null: Array) -> dict[str, str]:
    """Return, for each parameter in a null direction, a message that names the others in it."""
    reasons = {}
    for direction in null:
        members = [
            n for n, v in zip(names, direction, strict=True) if abs(v) > REGRESSION.null_share
        ]
        for name in members:
            others = " ".join(m for m in members if m != name) or "nothing else"
            reasons[name] = f"only a combination with {others} shows in these records"
    return reasons


def scores(beta: Array, triangles: Array) -> Array:
    """Return X'(y - X beta) (c, k) of clusters from their triangles (c, k+1, k+1)."""
    k = len(beta)
    X, y = triangles[:, :, :k], triangles[:, :, k]
    return np.asarray(np.einsum("cmk,cm->ck", X, y - X @ beta))


def _clustered(beta: Array, bread: Array, clusters: Sequence[RowCluster]) -> tuple[Array, Array]:
    """Return the stratified cluster covariance (k, k) and Satterthwaite's dof (k,)."""
    k = len(beta)
    labels: dict[tuple[Hashable, Hashable], int] = {}
    member = [labels.setdefault((c.stratum, c.key), len(labels)) for c in clusters]
    triangles = np.array([c.triangle for c in clusters]).reshape(-1, k + 1, k + 1)
    sums = sums_of(scores(beta, triangles), np.array(member, dtype=np.int64))
    number = {s: n for n, s in enumerate(dict.fromkeys(stratum for stratum, _ in labels))}
    strata = np.array([number[stratum] for stratum, _ in labels], dtype=np.int64)
    scatter = stratified(sums @ bread, strata)
    return (np.full((k, k), np.nan), np.full(k, np.nan)) if scatter is None else scatter


def stratified(influence: Array, *labels: Indices) -> tuple[Array, Array] | None:
    """Return sum over strata of n/(n-1) sum (u - mean)(u - mean)' (k, k) of influences u (c, k).

    A stratum has equal `labels`, each (c,). Also Satterthwaite's degrees of freedom (k,); None
    where a stratum has one member only.
    """
    _, number = numbered(*labels)
    n = np.bincount(number)[:, None]
    if (n < 2).any():
        return None
    u = (influence - (sums_of(influence, number) / n)[number]) * np.sqrt(n / (n - 1))[number]
    squares = np.sum(sums_of(u**2, number) ** 2 / (n - 1), axis=0)
    total = u.T @ u
    return total, satterthwaite(np.diag(total), squares)


def numbered(*labels: Indices) -> tuple[Indices, Indices]:
    """Return the first member (g,) of each group of equal labels (c,), and the group (c,)."""
    code = np.zeros(len(labels[0]), dtype=np.int64)
    for label in labels:
        values, code_of_label = np.unique(label, return_inverse=True)
        code = code * len(values) + code_of_label
    _, first, number = np.unique(code, return_index=True, return_inverse=True)
    return first, number


def sums_of(values: Array, number: Indices) -> Array:
    """Return the sums (g, ...) of values (c, ...) by group number (c,), 0 .. g - 1."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(number.max(initial=-1) + 1))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def satterthwaite(variance: Array, squares: Array) -> Array:
    """Return the degrees of freedom (k,) of a sum of variances (k,), 1 where all are zero.

    `squares` (k,) sums each part's square over its own degrees of freedom.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(squares > 0, variance**2 / squares, 1.0))


def half_width(std: Array, dof: Array) -> Array:
    """Return the half width of 95 % intervals by Student's t; `std` and `dof` of equal shape."""
    return np.asarray(stdtrit(np.maximum(dof, 1.0), 0.975) * std)
