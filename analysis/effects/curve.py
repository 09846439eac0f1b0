"""A free curve: a cubic spline by values at a few knots, straight beyond the data.

Between knots it is a cubic with continuous slope and curvature, the first and the last two pieces
being one cubic each (de Boor 1978, chapter IV: not-a-knot); beyond the first and the last knot it
is a straight line. It is linear in its values y at the knots t, which have its unit:

    f(x) = a y_j + b y_j+1 + ((a^3 - a) m_j + (b^3 - b) m_j+1) h^2 / 6,
    b = (x - t_j) / h, a = 1 - b, h = t_j+1 - t_j, m = S y (second derivatives, `bending`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numba import njit

from analysis.effects.base import Array, Shape

APART: Final = 0.02  # of the knots' range: the least distance between neighbours
POINTS: Final = 61  # of a plotted curve
LAST: Final = 0.999  # quantile of the outermost knots: beyond, the curve is straight


def bending(knots: Array) -> Array:
    """Return S (K, K): the second derivatives at the knots per unit of the values there."""
    K, h = len(knots), np.diff(knots)
    left, right = np.zeros((K, K)), np.zeros((K, K))
    for i in range(1, K - 1):
        left[i, i - 1 : i + 2] = h[i - 1] / 6.0, (h[i - 1] + h[i]) / 3.0, h[i] / 6.0
        right[i, i - 1 : i + 2] = 1.0 / h[i - 1], -1.0 / h[i - 1] - 1.0 / h[i], 1.0 / h[i]
    if K == 3:  # one parabola
        left[0, :2], left[2, 1:] = (1.0, -1.0), (-1.0, 1.0)
    else:
        left[0, :3] = -1.0 / h[0], 1.0 / h[0] + 1.0 / h[1], -1.0 / h[1]
        left[-1, -3:] = -1.0 / h[-2], 1.0 / h[-2] + 1.0 / h[-1], -1.0 / h[-1]
    return np.asarray(np.linalg.solve(left, right))


def spline(knots: Sequence[float], x: Array) -> Array:
    """Return the basis (n, K) of the curve at x (n,): its value per unit value at every knot."""
    t = np.asarray(knots, dtype=np.float64)
    return np.asarray(_basis(t, bending(t), np.ascontiguousarray(x, dtype=np.float64)))


@njit(cache=True, error_model="numpy")
def _basis(t, S, x):  # type: ignore[no-untyped-def]
    K = len(t)
    out = np.empty((len(x), K))
    for k in range(len(x)):
        inner = min(max(x[k], t[0]), t[-1])
        j = 0
        while j < K - 2 and inner >= t[j + 1]:
            j += 1
        h = t[j + 1] - t[j]
        b = (inner - t[j]) / h
        a, outside = 1.0 - b, x[k] - inner
        m, n = (a * a - 1.0) * a * h * h / 6.0, (b * b - 1.0) * b * h * h / 6.0
        if outside < 0.0:  # the slope at the first knot
            m, n = m - outside * h / 3.0, n - outside * h / 6.0
        elif outside > 0.0:  # at the last
            m, n = m + outside * h / 6.0, n + outside * h / 3.0
        for i in range(K):
            out[k, i] = m * S[j, i] + n * S[j + 1, i]
        out[k, j] += a - outside / h
        out[k, j + 1] += b + outside / h
    return out


def packed(knots: Sequence[float], values: Array) -> Array:
    """Return knots, values and second derivatives (3 K,), as `curve_at` reads them."""
    t = np.asarray(knots, dtype=np.float64)
    return np.concatenate((t, values, bending(t) @ values))


@njit(cache=True, error_model="numpy")
def curve_at(x, par, first, K):  # type: ignore[no-untyped-def]
    """Return the curve at x, its K knots, values and second derivatives in par from `first` on."""
    t, u = par[first], par[first + 1]
    y, z = par[first + K], par[first + K + 1]
    m, n = par[first + 2 * K], par[first + 2 * K + 1]
    for j in range(1, K - 1):
        if x >= par[first + j]:
            t, u = par[first + j], par[first + j + 1]
            y, z = par[first + K + j], par[first + K + j + 1]
            m, n = par[first + 2 * K + j], par[first + 2 * K + j + 1]
    h = u - t
    if x < par[first]:
        return y + (x - t) * ((z - y) / h - h / 6.0 * (2.0 * m + n))
    if x > par[first + K - 1]:
        return z + (x - u) * ((z - y) / h + h / 6.0 * (m + 2.0 * n))
    b = (x - t) / h
    a = 1.0 - b
    return a * y + b * z + ((a * a - 1.0) * a * m + (b * b - 1.0) * b * n) * h * h / 6.0


def knot_values(gauge: Array) -> Array:
    """Return the values at the knots per independent value (K, K - 1), where gauge (K,) . y = 0.

    The value with the largest weight depends on the others.
    """
    K, dependent = len(gauge), int(np.argmax(np.abs(gauge)))
    others = [k for k in range(K) if k != dependent]
    out = np.zeros((K, K - 1))
    out[others, range(K - 1)] = 1.0
    out[dependent] = -gauge[others] / gauge[dependent]
    return out


def shortest_wave(knots: Array) -> Array:
    """Return the gauge (K,) of a curve without its shortest wave: the highest divided difference.

    sum of y_k / prod (t_k - t_j) = 0: the values lie on a polynomial of one degree less.
    """
    t = np.asarray(knots, dtype=np.float64)
    apart = t[:, None] - t[None, :]
    np.fill_diagonal(apart, 1.0)
    gauge = 1.0 / np.prod(apart / (t[-1] - t[0]), axis=1)
    return np.asarray(gauge / np.linalg.norm(gauge))


def spread_knots(values: Array, quantiles: Sequence[float], low: float | None = None) -> Array:
    """Return knots (K,) at quantiles of values (n,), `APART` or more; `low` may fix the first.

    Empty where the values do not spread.
    """
    if not len(values):
        return np.zeros(0)
    knots = np.quantile(values, quantiles)
    if low is not None:
        knots[0] = low
    distance = APART * (knots[-1] - knots[0])
    if not distance > 0.0:
        return np.zeros(0)
    for k in range(1, len(knots)):
        knots[k] = max(knots[k], knots[k - 1] + distance)
    return np.asarray(knots)


def outer_knots(values: Array) -> Array:
    """Return the first and the last knot (2,) for values (n,), empty without any."""
    return np.quantile(values, (1.0 - LAST, LAST)) if len(values) else values


def knot_points(
    values: Array, quantiles: Sequence[float], low: float | None = None
) -> tuple[tuple[float, ...], ...]:
    """Return `spread_knots` as the only starting point of a search; none without a spread."""
    knots = spread_knots(values, quantiles, low)
    return (tuple(map(float, knots)),) if len(knots) else ()


def knot_shapes(names: Sequence[str], unit: str, low: float, high: float) -> tuple[Shape, ...]:
    """Return the knots as fixed shapes, evenly spread; `points` places them by the data."""
    even = np.linspace(low, high, len(names))
    return tuple(
        Shape(name, unit, min(low, -abs(high)), abs(high) + abs(low), (float(at),), fixed=True)
        for name, at in zip(names, even, strict=True)
    )


def shown(knots: Sequence[float]) -> Array:
    """Return the abscissae (m,) at which a curve between its outer knots is plotted."""
    return np.linspace(knots[0], knots[-1], POINTS)


def refuse_large(y: Array, limit: float, what: str, unit: str) -> str:
    """Return the message for a curve y (m,) [unit] that exceeds a limit ('' if it does not)."""
    most = float(np.max(np.abs(y))) if len(y) else 0.0
    return "" if most < limit else f"{what} reaches {most:.4g}, more than {limit:.4g} {unit}"
