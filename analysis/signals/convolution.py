"""Finite convolutions along the first axis, by numpy alone.

`scipy.signal` has them too and takes half a second to load.

Long records pass in blocks through the Fourier transform (overlap-save; Oppenheim and Schafer,
Discrete-Time Signal Processing, section 8.7); of a decimated convolution, only the samples that are
kept are computed.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK: Final = 4  # a block is at least so many times as long as the taps
GROUP: Final = 8  # decimated samples that are summed together


def convolved(x: Array, taps: Array) -> Array:
    """Return the convolution of x (n, ...) with taps (m,) inside x, shape (n - m + 1, ...)."""
    (rows,) = convolved_rows(x.reshape(len(x), -1).T, taps[None])
    return rows.T.reshape(-1, *x.shape[1:])


def convolved_rows(x: Array, taps: Array) -> list[Array]:
    """Return, for each of the taps (k, m), its convolution inside the rows of x (c, n)."""
    (rows, n), m = x.shape, taps.shape[1]
    size = 1 << (BLOCK * m - 1).bit_length()
    advance = size - m + 1
    count = -(-(n - m + 1) // advance)
    response = np.fft.rfft(taps, size)
    padded = np.zeros(count * advance + m - 1)
    blocks = sliding_window_view(padded, size)[::advance]
    out = [np.empty((rows, count, advance)) for _ in taps]
    spectrum, product = np.empty((2, count, size // 2 + 1), dtype=np.complex128)
    block = np.empty((count, size))
    # The arrays are reused for every row: allocating them would take as long as the transforms.
    for row in range(rows):
        padded[:n] = x[row]
        np.fft.rfft(blocks, out=spectrum)
        for result, transfer in zip(out, response, strict=True):
            np.fft.irfft(np.multiply(spectrum, transfer, out=product), size, out=block)
            result[row] = block[:, m - 1 :]
    return [result.reshape(rows, -1)[:, : n - m + 1] for result in out]


def same_convolved(x: Array, taps: Array) -> Array:
    """Return the convolution of x (n, ...) with an odd number of taps, zero-padded, shape of x."""
    reach = len(taps) // 2
    padded = np.zeros((len(x) + 2 * reach, *x.shape[1:]))
    padded[reach : reach + len(x)] = x
    return convolved(padded, taps)


def decimated(x: Array, taps: Array, step: int) -> Array:
    """Return samples j step, j integer, of the convolution of x (n, ...), taps (m,) inside x.

    The first has j = ceil((m - 1) / step); sample k of the whole convolution sums x[k - i] taps[i].
    """
    offset = -(-(len(taps) - 1) // step) * step - (len(taps) - 1)
    if len(x) < len(taps) + offset:
        return np.zeros((0, *x.shape[1:]))
    count = (len(x) - offset - len(taps)) // step + 1
    # Samples in chunks of GROUP steps: one matrix product has every chunk's part in the GROUP
    # outputs that begin in it (lag 0) and in those of each chunk before (lag 1, 2, ...).
    chunk, weights = GROUP * step, _weights(np.ascontiguousarray(taps).tobytes(), step)
    lags = weights.shape[1] // GROUP
    chunks = -(-count // GROUP)
    padded = np.zeros((int(np.prod(x.shape[1:])), (chunks + lags - 1) * chunk))
    available = min(len(x) - offset, padded.shape[1])
    padded[:, :available] = x.reshape(len(x), -1)[offset : offset + available].T
    partial = (padded.reshape(-1, chunk) @ weights).reshape(len(padded), -1, lags, GROUP)
    out: Array = partial[:, :chunks, 0].copy()
    for lag in range(1, lags):
        out += partial[:, lag : lag + chunks, lag]
    return out.reshape(len(padded), -1)[:, :count].T.reshape(count, *x.shape[1:])


@functools.lru_cache(maxsize=64)
def _weights(taps: bytes, step: int) -> Array:
    """Return the weights (GROUP step, lags GROUP) of the samples of a chunk in its outputs."""
    reversed_taps = np.frombuffer(taps)[::-1]
    chunk, room = GROUP * step, (GROUP - 1) * step
    lags = -(-(len(reversed_taps) + room) // chunk)
    padded = np.zeros((lags + 1) * chunk)
    padded[room : room + len(reversed_taps)] = reversed_taps
    starts = room + chunk * np.arange(lags)[:, None] - step * np.arange(GROUP)
    weights: Array = sliding_window_view(padded, chunk)[starts.ravel()].T
    return weights
