"""The matrix exponential, because scipy loads slowly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

TERMS = 18  # of its series: to the last digit


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e^matrix, (n, n), by its series of a part, squared again and again."""
    squarings = max(0, math.ceil(math.log2(max(float(np.abs(matrix).sum()), 1.0))))
    part = matrix / 2.0**squarings
    term = total = np.eye(len(matrix))
    for order in range(1, TERMS):
        term = term @ part / order
        total = total + term
    return np.linalg.matrix_power(total, 2**squarings)
