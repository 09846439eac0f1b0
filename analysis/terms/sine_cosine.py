"""Sine and cosine of one angle as plain arithmetic, for the equations that are simulated.

A call of the mathematical library takes longer than the rest of a term's kernel and prevents
vectorised loops; this is inlined and has no branch.
"""

from __future__ import annotations

from typing import Final

from numba import njit

PER_HALF_TURN: Final = 0.3183098861837907
# pi / 2 in two parts: products of the first with fewer than 2^20 half turns are exact.
HALF_PI_1, HALF_PI_2 = 1.5707963267341256, 6.077100506506192e-11
TO_WHOLE: Final = 6755399441055744.0  # 1.5 x 2^52: a number added to it is rounded to an integer

# Coefficients of fdlibm's k_sin.c and k_cos.c: errors below one unit in the last place to pi / 4.
S1, S2, S3, S4, S5, S6 = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
C1, C2, C3, C4, C5, C6 = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip


@njit(cache=True, error_model="numpy")
def sine_cosine(x):  # type: ignore[no-untyped-def]
    """Return sine and cosine of x [rad]; the error is below 5e-16 up to a million radians."""
    turns = (x * PER_HALF_TURN + TO_WHOLE) - TO_WHOLE
    h = (0.5 * x - turns * HALF_PI_1) - turns * HALF_PI_2  # half of the remainder
    z = h * h
    w = z * z
    s = h + h * z * ((S1 + z * S2) + w * (S3 + z * S4) + w * w * (S5 + z * S6))
    c = 1.0 - 0.5 * z + w * ((C1 + z * C2) + w * (C3 + z * C4) + w * w * (C5 + z * C6))
    # An odd number of half turns changes both signs.
    half = 0.5 * turns
    sign = 1.0 - 4.0 * abs(half - ((half + TO_WHOLE) - TO_WHOLE))
    twice = 2.0 * sign * s
    return twice * c, sign - twice * s
