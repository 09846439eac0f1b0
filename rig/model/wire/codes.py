"""Converter codes: the value of a 16-bit register for a voltage put out or a quantity measured.

Both ends of a wire and its documents use this definition: inputs are offset binary over the
sensor's range, outputs two's complement over +-range.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Codes = NDArray[np.int64]


def encode_input(value: ArrayLike, low: float, high: float, bits: int) -> Codes:
    """Return AD codes 0 .. 2^bits - 1 of values in [low, high] (SI); others saturate."""
    top = (1 << bits) - 1
    scaled = (np.asarray(value, dtype=np.float64) - low) * (top / (high - low))
    return np.clip(np.rint(scaled), 0, top).astype(np.int64)


def decode_input(code: ArrayLike, low: float, high: float, bits: int) -> Array:
    """Return the SI values of AD codes: low + code (high - low) / (2^bits - 1)."""
    top = (1 << bits) - 1
    return low + np.asarray(code, dtype=np.float64) * ((high - low) / top)


def encode_output(volts: ArrayLike, limit: float, bits: int) -> Codes:
    """Return DA codes -(2^(bits-1) - 1) .. 2^(bits-1) - 1 of voltages in [-limit, limit]."""
    top = (1 << (bits - 1)) - 1
    scaled = np.asarray(volts, dtype=np.float64) * (top / limit)
    return np.clip(np.rint(scaled), -top, top).astype(np.int64)


def decode_output(code: ArrayLike, limit: float, bits: int) -> Array:
    """Return the voltages [V] of DA codes: code limit / (2^(bits-1) - 1)."""
    top = (1 << (bits - 1)) - 1
    return np.asarray(code, dtype=np.float64) * (limit / top)
