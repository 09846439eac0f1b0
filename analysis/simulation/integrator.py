"""The integrator of the identified model: Dormand and Prince's embedded pair 5(4) in numba.

Compiled once for every model: the right-hand side comes as a machine address
(`analysis.simulation.equations`). Output falls on the samples by the pair's own 4th-order
interpolation, so a step may be longer than a sample. Source: Hairer, Norsett and Wanner, Solving
Ordinary Differential Equations I, tables II.5.2 and section II.6.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit

from analysis.simulation.equations import NOT_FINITE, OK, STEP_TOO_SMALL, call_rates

MIN_STEP: Final = 1e-7  # [s]
DOUBLE: Final = 8  # bytes

# Weights of the stages' derivatives (rows 2 to 7 of the table), of the error, of the interpolation.
A21: Final = 1 / 5
A31, A32 = 3 / 40, 9 / 40
A41, A42, A43 = 44 / 45, -56 / 15, 32 / 9
A51, A52, A53, A54 = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
A61, A62, A63, A64, A65 = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
A71, A73, A74, A75, A76 = 35 / 384, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
C: Final = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
E1, E3, E4, E5, E6, E7 = (
    71 / 57600, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40,
)  # fmt: skip
D1, D3, D4, D5, D6, D7 = (
    -12715105075 / 11282082432, 87487479700 / 32700410799, -10690763975 / 1880347072,
    701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
)  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _trial(stage, h, y, k, trial):  # type: ignore[no-untyped-def]
    """Fill the state of a further stage, 1 to 6, from the derivatives k (7, size) before it."""
    if stage == 1:
        for j in range(len(y)):
            trial[j] = y[j] + h * (A21 * k[0, j])
    elif stage == 2:
        for j in range(len(y)):
            trial[j] = y[j] + h * (A31 * k[0, j] + A32 * k[1, j])
    elif stage == 3:
        for j in range(len(y)):
            trial[j] = y[j] + h * (A41 * k[0, j] + A42 * k[1, j] + A43 * k[2, j])
    elif stage == 4:
        for j in range(len(y)):
            total = A51 * k[0, j] + A52 * k[1, j] + A53 * k[2, j] + A54 * k[3, j]
            trial[j] = y[j] + h * total
    elif stage == 5:
        for j in range(len(y)):
            total = A61 * k[0, j] + A62 * k[1, j] + A63 * k[2, j] + A64 * k[3, j] + A65 * k[4, j]
            trial[j] = y[j] + h * total
    else:
        for j in range(len(y)):
            total = A71 * k[0, j] + A73 * k[2, j] + A74 * k[3, j] + A75 * k[4, j] + A76 * k[5, j]
            trial[j] = y[j] + h * total


@njit(cache=True, error_model="numpy", nogil=True)
def _error(h, y, trial, k, rtol, atol):  # type: ignore[no-untyped-def]
    """Return the embedded error over the tolerance, root mean square over the state."""
    error = 0.0
    for j in range(len(y)):
        e = E1 * k[0, j] + E3 * k[2, j] + E4 * k[3, j] + E5 * k[4, j] + E6 * k[5, j] + E7 * k[6, j]
        scale = atol[j] + rtol * max(abs(y[j]), abs(trial[j]))
        error += (h * e / scale) ** 2
    return math.sqrt(error / len(y))


@njit(cache=True, error_model="numpy", nogil=True)
def _interpolate(t, h, y, trial, k, rate, r, ys, filled):  # type: ignore[no-untyped-def]
    """Fill the samples that lie in the step just taken; return how many are filled so far.

    `r` (4, size) is workspace for the interpolation's coefficients.
    """
    if not (filled < len(ys) and filled / rate <= t + h + 1e-12):
        return filled
    for j in range(len(y)):
        r[0, j] = trial[j] - y[j]
        r[1, j] = h * k[0, j] - r[0, j]
        r[2, j] = r[0, j] - h * k[6, j] - r[1, j]
        total = h * D1 * k[0, j] + h * D3 * k[2, j] + h * D4 * k[3, j]
        r[3, j] = total + h * D5 * k[4, j] + h * D6 * k[5, j] + h * D7 * k[6, j]
    while filled < len(ys) and filled / rate <= t + h + 1e-12:
        a = min((filled / rate - t) / h, 1.0)
        b = 1.0 - a
        for j in range(len(y)):
            ys[filled, j] = y[j] + a * (r[0, j] + b * (r[1, j] + a * (r[2, j] + b * r[3, j])))
        filled += 1
    return filled


@njit(cache=True, error_model="numpy", nogil=True)
def integrate(  # type: ignore[no-untyped-def]
    address, context, par, geometry, work, inputs, rate, locked, rtol, atol, ys
):
    """Integrate from ys[0]; fill ys (n, size) and return (status, samples filled, evaluations).

    The other arguments are those of `analysis.simulation.equations`.
    """
    n, size = ys.shape
    y, trial, k, r = ys[0].copy(), np.empty(size), np.zeros((7, size)), np.empty((4, size))
    m, at_inputs, at_locked = inputs.shape[0], inputs.ctypes.data, locked.ctypes.data
    at_geometry, at_par = geometry.ctypes.data, par.ctypes.data
    at_context, at_work = context.ctypes.data, work.ctypes.data
    at_y, at_k = trial.ctypes.data, k.ctypes.data
    t, h, filled, evaluations = 0.0, 0.2 / rate, 1, 1
    end = (n - 1) / rate + 1e-9
    trial[:] = y
    status = call_rates(
        address, t, at_y, at_k, at_inputs, m, rate, at_locked, at_geometry, at_par, at_context,
        at_work,
    )  # fmt: skip
    if status != OK:
        return status, filled, evaluations
    after_failure = False
    while filled < n:
        h = max(min(h, end - t), MIN_STEP)
        for stage in range(1, 7):
            _trial(stage, h, y, k, trial)
            status = call_rates(
                address, t + C[stage] * h, at_y, at_k + DOUBLE * size * stage, at_inputs, m, rate,
                at_locked, at_geometry, at_par, at_context, at_work,
            )  # fmt: skip
            evaluations += 1
            if status != OK:
                break
        error = _error(h, y, trial, k, rtol, atol) if status == OK else np.inf
        if not error <= 1.0:
            if h <= MIN_STEP:
                if status == OK:
                    status = STEP_TOO_SMALL if error < np.inf else NOT_FINITE
                return status, filled, evaluations
            h *= max(0.2, 0.9 * error**-0.2) if error < 1e6 else 0.2
            after_failure = True
            continue
        filled = _interpolate(t, h, y, trial, k, rate, r, ys, filled)
        t += h
        for j in range(size):
            y[j], k[0, j] = trial[j], k[6, j]
        grow = 0.9 * max(error, 1e-8) ** -0.2
        h *= min(grow, 1.0 if after_failure else 5.0)
        after_failure = False
    return OK, filled, evaluations
