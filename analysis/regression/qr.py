"""Sequential QR: any number of rows reduced to a triangle in the memory of one block.

[X y] = Q R block by block: the previous triangle on top of the next rows, one Householder QR, and
only R (k+1, k+1) is kept (a sequential TSQR: Golub and Van Loan, section 5.1.9 and the flat tree of
Demmel et al. 2012). Every block is small enough for the processor's cache, which is why this is
faster than one QR of all rows. The clustered standard errors need X'(y - X beta) of each cluster,
which follows from its triangle (`analysis.regression.solve.scores`), so that one triangle per
repeat is kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from analysis.regression.settings import REGRESSION

Array = NDArray[np.float64]


class Accumulator:
    """The triangle of all rows added so far, in memory independent of their number."""

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
        """Add rows (m, k), (m,); raises ValueError if they do not fit."""
        if matrix.shape != (len(rhs), self._width - 1):
            raise ValueError(f"rows {matrix.shape}, {rhs.shape} do not fit {self._width - 1}")
        for first in range(0, len(rhs), self._block):
            part = slice(first, first + self._block)
            count = len(rhs[part])
            space = self._stack(count)
            space[self._width :, :-1] = matrix[part]
            space[self._width :, -1] = rhs[part]
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
        """Return space (k+1 + count, k+1) in LAPACK's order with the triangle on top."""
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
