"""The integrator of the identified model: Dormand and Prince's embedded pair 5(4) in numba.

Compiled once for every model: terms come as machine addresses, so that adding a term compiles
that term alone. Output falls on the samples by the pair's own 4th-order
interpolation, so a step may be longer than a sample. Source: Hairer, Norsett and Wanner, Solving
Ordinary Differential Equations I, tables II.5.2 and section II.6.

State y = [q (N), dq/dt (N), p_cap (N), p_rod (N), hidden]; M q'' = torques, and in each chamber
(V/b) dp/dt = flow in - A ds/dt (cap), + A ds/dt (rod). A locked joint follows its measured motion.
An electric joint has its drive's torque, s = q, G = 1, and pressures that stay zero.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    KERNEL_SIGNATURE,
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    PREPARE,
    QD,
    SD,
    TEMPERATURE,
    THETA,
    TIME,
    TORQUE,
    V_CAP,
    V_ROD,
    G,
    Q,
    S,
    U,
)

OK, LEFT_STROKE, NOT_FINITE, STEP_TOO_SMALL, BAD_INERTIA = range(5)
MIN_STEP: Final = 1e-7  # [s]

# Columns of `geometry`, one row per joint.
# GAIN is 0 of a hydraulic joint; of an
# electric one it is the drive's, u being the drive and OFFSET the known turn of the joint's zero.
PIN_A, PIN_C, MID, OFFSET, AREA_CAP, AREA_ROD, DEAD_CAP, DEAD_ROD, STROKE, GAIN = range(10)

_A = np.array(
    [
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_C = np.array([1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_D = np.array(
    [
        -12715105075 / 11282082432, 0, 87487479700 / 32700410799, -10690763975 / 1880347072,
        701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
    ]
)  # fmt: skip


@njit(cache=True, error_model="numpy")
def _observe(t, y, inputs, rate, locked, geometry, bench, x, q_dd):  # type: ignore[no-untyped-def]
    """Fill `bench` and `x` at time t; return False where a piston left its cylinder."""
    N = x.shape[1]
    place = min(max(t * rate, 0.0), inputs.shape[0] - 1.0)
    low = min(int(place), inputs.shape[0] - 2)
    w = place - low
    bench[TIME] = t
    bench[P_S] = inputs[low, 0] + w * (inputs[low + 1, 0] - inputs[low, 0])
    bench[P_TANK] = 0.0
    bench[TEMPERATURE] = inputs[low, 1] + w * (inputs[low + 1, 1] - inputs[low, 1])
    inside = True
    angle = 0.0
    for i in range(N):
        x[U, i] = inputs[low, 2 + i] + w * (inputs[low + 1, 2 + i] - inputs[low, 2 + i])
        if locked[i]:
            for k in range(3):
                column = 2 + (k + 1) * N + i
                value = inputs[low, column] + w * (inputs[low + 1, column] - inputs[low, column])
                if k == 0:
                    x[Q, i] = value
                elif k == 1:
                    x[QD, i] = value
                else:
                    q_dd[i] = value
        else:
            x[Q, i] = y[i]
            x[QD, i] = y[N + i]
        angle += x[Q, i]
        if geometry[i, GAIN] != 0.0:
            angle += geometry[i, OFFSET]
            x[THETA, i], x[G, i], x[S, i], x[SD, i] = angle, 1.0, x[Q, i], x[QD, i]
            x[P_CAP, i] = x[P_ROD, i] = x[V_CAP, i] = x[V_ROD, i] = 0.0
            continue
        x[THETA, i] = angle
        a, c = geometry[i, PIN_A], geometry[i, PIN_C]
        beta = x[Q, i] + geometry[i, OFFSET]
        length = math.sqrt(a * a + c * c - 2.0 * a * c * math.cos(beta))
        x[G, i] = a * c * math.sin(beta) / length
        x[S, i] = length - geometry[i, MID]
        x[SD, i] = x[G, i] * x[QD, i]
        x[P_CAP, i] = y[2 * N + i]
        x[P_ROD, i] = y[3 * N + i]
        half = 0.5 * geometry[i, STROKE]
        x[V_CAP, i] = geometry[i, DEAD_CAP] + (half + x[S, i]) * geometry[i, AREA_CAP]
        x[V_ROD, i] = geometry[i, DEAD_ROD] + (half - x[S, i]) * geometry[i, AREA_ROD]
        # Half a stroke past its end no cylinder is; the chamber volumes are still positive there.
        if not (abs(x[S, i]) < 2.0 * half) or x[V_CAP, i] <= 0.0 or x[V_ROD, i] <= 0.0:
            inside = False
    return inside


@njit(cache=True, error_model="numpy")
def _impose(M, load, locked, q_dd):  # type: ignore[no-untyped-def]
    """Replace the rows of locked joints by their given q'', moved to the others' loads."""
    for i in range(len(load)):
        if locked[i]:
            for j in range(len(load)):
                load[j] -= M[j, i] * q_dd[i]
                M[i, j] = M[j, i] = 0.0
            M[i, i], load[i] = 1.0, q_dd[i]


@njit(cache=True, error_model="numpy")
def _accelerate(M, load, q_dd):  # type: ignore[no-untyped-def]
    """Solve M q'' = load by Cholesky, M becoming its factor; False where M is not > 0."""
    N = len(load)
    for i in range(N):
        for j in range(i + 1):
            total = M[i, j]
            for k in range(j):
                total -= M[i, k] * M[j, k]
            if i > j:
                M[i, j] = total / M[j, j]
            elif total > 0.0:
                M[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(N):
        total = load[i]
        for k in range(i):
            total -= M[i, k] * q_dd[k]
        q_dd[i] = total / M[i, i]
    for i in range(N - 1, -1, -1):
        total = q_dd[i]
        for k in range(i + 1, N):
            total -= M[k, i] * q_dd[k]
        q_dd[i] = total / M[i, i]
    return True


_V, _W = types.float64[::1], types.float64[:, ::1]
_I, _B = types.int64[::1], types.boolean[::1]
SIGNATURE = types.Tuple((types.int64, types.int64, types.int64))(
    types.Tuple((_I, _I, _I, _B, _V)), _W, types.float64, _B, _W, types.float64, _V, _W,
    types.Tuple((_V, _W, _W, _W, _V)),
)  # fmt: skip


@intrinsic
def _call(typing, address, phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    """Call the term's kernel at a machine address (numba's C convention for its own types)."""
    signature = types.void(types.int64, *KERNEL_SIGNATURE.args)

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        values = [context.get_value_type(kind) for kind in KERNEL_SIGNATURE.args]
        result = context.get_value_type(types.none)
        pointer = ir.FunctionType(result, values).as_pointer()
        builder.call(builder.inttoptr(args[0], pointer), args[1:])
        return context.get_dummy_value()

    return signature, generate


@njit(cache=True, error_model="numpy")
def rates(t, y, dy, inputs, rate, locked, geometry, model, work):  # type: ignore[no-untyped-def]
    """Fill dy; return OK or why there is no derivative."""
    addresses, ends, hidden_ends, prepares, par = model
    bench, x, out, M, q_dd = work
    N = x.shape[1]
    if not _observe(t, y, inputs, rate, locked, geometry, bench, x, q_dd):
        return LEFT_STROKE
    out[:] = 0.0
    M[:] = 0.0
    for phase in (PREPARE, CONTRIBUTE):
        for m in range(len(ends) - 1):
            if phase == CONTRIBUTE or prepares[m]:
                z = slice(4 * N + hidden_ends[m], 4 * N + hidden_ends[m + 1])
                p = slice(ends[m], ends[m + 1])
                _call(addresses[m], phase, bench, x, y[z], par[p], out, M, dy[z])
    for i in range(N):
        if geometry[i, GAIN] != 0.0:
            out[TORQUE, i] += geometry[i, GAIN] * x[U, i]
            continue
        force = geometry[i, AREA_CAP] * x[P_CAP, i] - geometry[i, AREA_ROD] * x[P_ROD, i]
        out[TORQUE, i] += x[G, i] * force
    _impose(M, out[TORQUE], locked, q_dd)
    if not _accelerate(M, out[TORQUE], q_dd):
        return BAD_INERTIA
    for i in range(N):
        if locked[i]:
            dy[i] = dy[N + i] = dy[2 * N + i] = dy[3 * N + i] = 0.0
            continue
        dy[i] = x[QD, i]
        dy[N + i] = q_dd[i]
        if geometry[i, GAIN] != 0.0:
            dy[2 * N + i] = dy[3 * N + i] = 0.0
            continue
        cap, rod = geometry[i, AREA_CAP] * x[SD, i], geometry[i, AREA_ROD] * x[SD, i]
        dy[2 * N + i] = (out[FLOW_CAP, i] - cap) / out[COMP_CAP, i]
        dy[3 * N + i] = (out[FLOW_ROD, i] + rod) / out[COMP_ROD, i]
    return OK


@njit(cache=True, error_model="numpy")
def _stages(t, h, y, trial, k, inputs, rate, locked, geometry, model, work):  # type: ignore[no-untyped-def]
    """Fill the six further stages k[1:] and the 5th-order `trial`; return (status, evaluations)."""
    for stage in range(6):
        for j in range(len(y)):
            total = 0.0
            for m in range(stage + 1):
                total += _A[stage, m] * k[m, j]
            trial[j] = y[j] + h * total
        at = t + _C[stage] * h
        status = rates(at, trial, k[stage + 1], inputs, rate, locked, geometry, model, work)
        if status != OK:
            return status, stage + 1
    return OK, 6


@njit(cache=True, error_model="numpy")
def _error(h, y, trial, k, rtol, atol):  # type: ignore[no-untyped-def]
    """Return the embedded error over the tolerance, root mean square over the state."""
    error = 0.0
    for j in range(len(y)):
        e = 0.0
        for m in range(7):
            e += _E[m] * k[m, j]
        scale = atol[j] + rtol * max(abs(y[j]), abs(trial[j]))
        error += (h * e / scale) ** 2
    return math.sqrt(error / len(y))


@njit(cache=True, error_model="numpy")
def _interpolate(t, h, y, trial, k, rate, ys, filled):  # type: ignore[no-untyped-def]
    """Fill the samples that lie in the step just taken; return how many are filled now."""
    n = ys.shape[0]
    reached = filled
    while reached < n and reached / rate <= t + h + 1e-12:
        reached += 1
    for j in range(len(y) if reached > filled else 0):
        r2 = trial[j] - y[j]
        r3 = h * k[0, j] - r2
        r4 = r2 - h * k[6, j] - r3
        r5 = 0.0
        for m in range(7):
            r5 += h * _D[m] * k[m, j]
        for i in range(filled, reached):
            a = min((i / rate - t) / h, 1.0)
            ys[i, j] = y[j] + a * (r2 + (1.0 - a) * (r3 + a * (r4 + (1.0 - a) * r5)))
    return reached


@njit(SIGNATURE, cache=True, error_model="numpy")
def integrate(model, inputs, rate, locked, geometry, rtol, atol, ys, work):  # type: ignore[no-untyped-def]
    """Integrate from ys[0]; fill ys (n, size) and return (status, samples filled, evaluations).

    `model` = (addresses, ends, hidden_ends, prepares, par), `work` = (bench, x, out, M, q_dd),
    `inputs` (n, 2 + 4 N): p_s, temperature, u, and q, q', q'' of the locked joints.
    """
    n, size = ys.shape
    k = np.zeros((7, size))
    y, trial = ys[0].copy(), np.empty(size)
    t, h, filled, evaluations = 0.0, 0.2 / rate, 1, 1
    end = (n - 1) / rate + 1e-9
    status = rates(t, y, k[0], inputs, rate, locked, geometry, model, work)
    if status != OK:
        return status, filled, evaluations
    after_failure = False
    while filled < n:
        h = max(min(h, end - t), MIN_STEP)
        status, used = _stages(t, h, y, trial, k, inputs, rate, locked, geometry, model, work)
        evaluations += used
        error = _error(h, y, trial, k, rtol, atol) if status == OK else np.inf
        if not error <= 1.0:
            if h <= MIN_STEP:
                if status == OK:
                    status = STEP_TOO_SMALL if error < np.inf else NOT_FINITE
                return status, filled, evaluations
            h *= max(0.2, 0.9 * error**-0.2) if error < 1e6 else 0.2
            after_failure = True
            continue
        filled = _interpolate(t, h, y, trial, k, rate, ys, filled)
        t += h
        y[:] = trial
        k[0] = k[6]
        grow = 0.9 * max(error, 1e-8) ** -0.2
        h *= min(grow, 1.0 if after_failure else 5.0)
        after_failure = False
    return OK, filled, evaluations
