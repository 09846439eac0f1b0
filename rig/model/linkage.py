"""Geometry of a cylinder between two pins: piston displacement against joint angle.

Source: Sakai and Maeshima, section II: (lc + s)^2 = a^2 + c^2 - 2 a c cos(beta), beta = q + offset,
with s = 0 at mid-stroke and lc the length there. The triangle's angle beta is taken in (0, pi), so
that extending the cylinder opens it and G = ds/dq = a c sin(beta) / (lc + s) is positive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def angle_from_piston(
    piston: ArrayLike, a: float, c: float, mid_length: float, offset: float
) -> Array:
    """Return the joint angle q [rad], in (-pi, pi] at mid-stroke, of piston displacement s [m]."""
    length = mid_length + np.asarray(piston, dtype=np.float64)
    beta = np.arccos((a * a + c * c - length * length) / (2.0 * a * c))
    middle = np.arccos((a * a + c * c - mid_length * mid_length) / (2.0 * a * c)) - offset
    turns = np.round(middle / (2.0 * np.pi))
    return np.asarray(beta - offset - 2.0 * np.pi * turns, dtype=np.float64)


def geometry_from_piston(
    piston: ArrayLike, a: float, c: float, mid_length: float, offset: float
) -> tuple[Array, Array, Array]:
    """Return the angle q [rad], G = ds/dq [m] and dG/dq [m/rad] of piston displacement s [m]."""
    q = angle_from_piston(piston, a, c, mid_length, offset)
    length = mid_length + np.asarray(piston, dtype=np.float64)
    slope = a * c * np.sin(q + offset) / length
    cosine = (a * a + c * c - length * length) / (2.0 * a * c)
    return q, slope, np.asarray((a * c * cosine - slope * slope) / length)


def piston_from_angle(q: ArrayLike, a: float, c: float, mid_length: float, offset: float) -> Array:
    """Return the piston displacement s [m] of joint angle q [rad]."""
    beta = np.asarray(q, dtype=np.float64) + offset
    return np.asarray(np.sqrt(a * a + c * c - 2.0 * a * c * np.cos(beta)) - mid_length)


def jacobian(q: ArrayLike, a: float, c: float, mid_length: float, offset: float) -> Array:
    """Return G = ds/dq [m] at joint angle q [rad]."""
    beta = np.asarray(q, dtype=np.float64) + offset
    length = np.sqrt(a * a + c * c - 2.0 * a * c * np.cos(beta))
    return np.asarray(a * c * np.sin(beta) / length)


def jacobian_rate(q: ArrayLike, a: float, c: float, mid_length: float, offset: float) -> Array:
    """Return dG/dq = d2s/dq2 [m/rad] at joint angle q [rad]."""
    beta = np.asarray(q, dtype=np.float64) + offset
    cosine = np.cos(beta)
    length = np.sqrt(a * a + c * c - 2.0 * a * c * cosine)
    slope = a * c * np.sin(beta) / length
    return np.asarray((a * c * cosine - slope * slope) / length)
