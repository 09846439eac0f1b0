"""Finite convolutions along the first axis, by numpy alone.

`scipy.signal` has them too and takes half a second to load.

Long records pass in blocks through the Fourier transform (overlap-save; Oppenheim and Schafer,
Discrete-Time Signal Processing, section 8.7); where only every so many samples are wanted, only
those are summed.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK: Final = 8  # a block is at least so many times as long as the taps


def convolved(x: Array, taps: Array) -> Array:
    """Return the convolution of x (n, ...) with taps (m,) inside x, shape (n - m + 1, ...)."""
    m, n = len(taps), len(x)
    size = 1 << (BLOCK * m - 1).bit_length()
    fresh = size - m + 1
    count = -(-(n - m + 1) // fresh)
    flat = np.zeros((int(np.prod(x.shape[1:])), count * fresh + m - 1))
    flat[:, :n] = x.reshape(n, -1).T
    blocks = sliding_window_view(flat, size, axis=1)[:, ::fresh]
    spectrum = np.fft.rfft(blocks) * np.fft.rfft(taps, size)
    out = np.fft.irfft(spectrum, size)[:, :, m - 1 :].reshape(len(flat), -1)[:, : n - m + 1]
    return np.ascontiguousarray(out.T).reshape(n - m + 1, *x.shape[1:])


def same_convolved(x: Array, taps: Array) -> Array:
    """Return the convolution of x (n, ...) with an odd number of taps, zero-padded, shape of x."""
    reach = len(taps) // 2
    wide = np.zeros((len(x) + 2 * reach, *x.shape[1:]))
    wide[reach : reach + len(x)] = x
    return convolved(wide, taps)


def decimated(x: Array, taps: Array, step: int) -> Array:
    """Return samples j step, j integer, of the convolution of x (n, ...), taps (m,) inside x.

    The first has j = ceil((m - 1) / step); sample k of the whole convolution sums x[k - i] taps[i].
    """
    first = -(-(len(taps) - 1) // step) * step - (len(taps) - 1)
    if len(x) < len(taps) + first:
        return np.zeros((0, *x.shape[1:]))
    count = (len(x) - first - len(taps)) // step + 1
    # Taps and samples cut into rows of `step`: one matrix product has all partial sums.
    rows = -(-len(taps) // step)
    turned = np.zeros(rows * step)
    turned[: len(taps)] = taps[::-1]
    flat = np.zeros((int(np.prod(x.shape[1:])), (count + rows - 1) * step))
    within = min(len(x) - first, flat.shape[1])
    flat[:, :within] = x.reshape(len(x), -1)[first : first + within].T
    partial = flat.reshape(len(flat), -1, step) @ turned.reshape(rows, step).T
    out = partial[:, :count, 0].copy()
    for row in range(1, rows):
        out += partial[:, row : row + count, row]
    return np.ascontiguousarray(out.T).reshape(count, *x.shape[1:])
