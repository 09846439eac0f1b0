"""Opening of a metering edge over the spool's travel x past it.

    opening = (x + (|x|^n + r^n)^(1/n)) / 2, n = 2 + c

Radial clearance passes oil before and beside the edge: r is the rounding, 0 for a sharp edge, and c
= 0 (Merritt 1967, chapter 5: the orifice is as wide as the hypotenuse of opening and clearance). A
worn edge approaches the straight line at a small distance: the larger c, the corner, the smaller
that distance. At x = 0 the opening is r / 2 for any c.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit

from analysis.effects.base import Array, Shape

CORNER: Final = 1.0  # where a search begins
# Below, the curve is nearly that of a 0, where a form has no corner; above, it is straight lines.
CORNER_BOUNDS: Final = (0.1, 10.0)


def rounding(name: str, stroke: float) -> Shape:
    """Return an edge's rounding [V], from sharp to 20 % of the spool's stroke [V].

    Clearances of some micrometres on a stroke of some tenths of a millimetre, and the notches of a
    proportional valve's edges. At x = 0 the edge is open by half of its rounding: up to a tenth of
    the stroke.
    """
    return Shape(name, "V", 0.0, 0.2 * stroke, (0.002 * stroke,), resolution=True)


def corner(name: str) -> Shape:
    """Return the shape of an edge's corner, a detail of its form: 0 where not given."""
    return Shape(name, "", *CORNER_BOUNDS, (CORNER,), saturates=True, detail=True)


def opened(x: Array, r: float, c: float) -> Array:
    """Return how far an edge at x (n,) [V] is open, with rounding r [V] and corner c."""
    if c == 0.0:
        return np.asarray(0.5 * (x + np.hypot(x, r)))
    far, n = np.abs(x), 2.0 + c
    scale = np.maximum(np.maximum(far, r), 1e-30)  # no power of a small number underflows
    return np.asarray(0.5 * (x + scale * ((far / scale) ** n + (r / scale) ** n) ** (1.0 / n)))


@njit(cache=True)
def edge(x, r, c):  # type: ignore[no-untyped-def]
    """Return `opened` at one x."""
    if c == 0.0:
        return 0.5 * (x + math.hypot(x, r))
    far, n = abs(x), 2.0 + c
    scale = max(far, r)
    if scale <= 0.0:
        return 0.0
    return 0.5 * (x + scale * ((far / scale) ** n + (r / scale) ** n) ** (1.0 / n))
