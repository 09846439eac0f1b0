"""Least squares with columns scaled to unit norm, and the threshold for numerical rank.

Columns have unlike units (kg m^2, N m s, 1/Pa); scaled by D = diag(1/|x_j|) all have norm 1, and a
singular value of X D means the same for every problem. Directions whose singular value is below
RANK_TOLERANCE times the largest are not determined by the rows and get no value. Source: Bjorck,
Numerical Methods for Least Squares Problems, sections 2.8.1 (scaling) and 2.7 (numerical rank).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.settings import REGRESSION

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScaledFactors:
    """The singular value decomposition U diag(sigma) Vt of rows X (m, k) with unit columns.

    `scale` (k,) are the norms of the columns, 1 for a column of zeros; `sigma` (k,), `Vt` (k, k).
    """

    scale: Array
    U: Array
    sigma: Array
    Vt: Array

    @property
    def determined(self) -> NDArray[np.bool_]:
        """The mask (k,) of the directions that the rows determine."""
        return np.asarray(self.sigma > REGRESSION.rank_tolerance * max(self.sigma[0], 1e-300))

    @property
    def null(self) -> Array:
        """The directions (l, k), in scaled parameters, that the rows do not determine."""
        return self.Vt[~self.determined]

    @property
    def condition(self) -> float:
        """Condition number of the scaled matrix; infinite where a column adds nothing at all."""
        return float(self.sigma[0] / self.sigma[-1]) if self.sigma[-1] > 0 else float("inf")

    @property
    def inverse(self) -> Array:
        """The pseudo-inverse (k, m) of X over the directions that it determines."""
        determined = self.determined
        directions = self.Vt[determined].T / self.sigma[determined] / self.scale[:, None]
        return np.asarray(directions @ self.U[:, determined].T)


def column_scale(X: Array) -> Array:
    """Return the norms (k,) of the columns of X (m, k), 1 for a column of zeros."""
    size = np.linalg.norm(X, axis=0)
    return np.where(size > 0.0, size, 1.0)


def factored(X: Array) -> ScaledFactors:
    """Decompose rows or a triangle X (m, k), k > 0, with columns scaled to unit norm."""
    m, k = X.shape
    scale = column_scale(X)
    # With fewer rows than columns, rows of zeros complete the directions Vt.
    filled = np.vstack((X / scale, np.zeros((max(k - m, 0), k))))
    U, sigma, Vt = np.linalg.svd(filled, full_matrices=False)
    return ScaledFactors(scale, U[:m], sigma, Vt)


def least_squares(X: Array, y: Array) -> Array:
    """Return the shortest beta (k,), in scaled columns, that minimises |y - X beta|."""
    return np.asarray(factored(X).inverse @ y)


def shortest(X: Array, y: Array, rank: float) -> Array:
    """Return beta (k,) or (k, n) that minimises |y - X beta|, X (m, k), y (m,) or (m, n).

    Directions of the scaled columns below `rank` times the largest singular value get no value.
    """
    scale = column_scale(X)
    return np.asarray((np.linalg.lstsq(X / scale, y, rcond=rank)[0].T / scale).T)


def scaled_inverse(A: Array) -> Array:
    """Invert a matrix A (k, k) of normal or estimating equations, its diagonal scaled to 1.

    Weak directions are kept, because an interval must include their large variance. Left out are
    directions beyond double precision (`rank_tolerance_normal`) and columns with a zero diagonal.
    """
    scale = np.sqrt(np.abs(np.diag(A)))
    filled = scale > 0.0
    size = np.outer(scale[filled], scale[filled])
    inverse = np.zeros_like(A)
    inner = np.linalg.pinv(A[np.ix_(filled, filled)] / size, REGRESSION.rank_tolerance_normal)
    inverse[np.ix_(filled, filled)] = inner / size
    return inverse
