"""The right-hand side of any model, term by term: each term's kernel is called by its address.

Compiled once for every model, so that adding a term compiles that term alone. It is used for models
that are simulated too seldom to compile a right-hand side for them (`analysis.simulation.fused`),
and as the reference in that one's tests: both do the same operations in the same order.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import carray, cfunc, njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from analysis.simulation import equations as eq
from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    KERNEL_SIGNATURE,
    OUT_ROWS,
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
    X_ROWS,
    G,
    Q,
    S,
    U,
    Used,
)
from analysis.terms.sine_cosine import sine_cosine


@njit(cache=True, error_model="numpy")
def _observe(t, y, inputs, rate, locked, geometry, bench, x, q_dd):  # type: ignore[no-untyped-def]
    """Fill `bench` and `x` at time t; return False where a piston left its cylinder."""
    N = x.shape[1]
    sample = min(max(t * rate, 0.0), inputs.shape[0] - 1.0)
    low = min(int(sample), inputs.shape[0] - 2)
    w = sample - low
    bench[TIME] = inputs[0, 2 + 4 * N] + t  # since the record began
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
        if geometry[i, eq.GAIN] != 0.0:
            angle += geometry[i, eq.OFFSET]
            x[THETA, i], x[G, i], x[S, i], x[SD, i] = angle, 1.0, x[Q, i], x[QD, i]
            x[P_CAP, i] = x[P_ROD, i] = x[V_CAP, i] = x[V_ROD, i] = 0.0
            continue
        x[THETA, i] = angle
        a, c = geometry[i, eq.PIN_A], geometry[i, eq.PIN_C]
        beta = x[Q, i] + geometry[i, eq.OFFSET]
        sine, cosine = sine_cosine(beta)
        length = math.sqrt(a * a + c * c - 2.0 * a * c * cosine)
        x[G, i] = a * c * sine / length
        x[S, i] = length - geometry[i, eq.MID]
        x[SD, i] = x[G, i] * x[QD, i]
        x[P_CAP, i] = y[2 * N + i]
        x[P_ROD, i] = y[3 * N + i]
        half = 0.5 * geometry[i, eq.STROKE]
        x[V_CAP, i] = geometry[i, eq.DEAD_CAP] + (half + x[S, i]) * geometry[i, eq.AREA_CAP]
        x[V_ROD, i] = geometry[i, eq.DEAD_ROD] + (half - x[S, i]) * geometry[i, eq.AREA_ROD]
        # No real cylinder goes half a stroke past its end; chamber volumes are still positive
        # there.
        if not (abs(x[S, i]) < 2.0 * half) or x[V_CAP, i] <= 0.0 or x[V_ROD, i] <= 0.0:
            inside = False
    return inside


@njit(cache=True, error_model="numpy")
def _impose(M, load, locked, q_dd):  # type: ignore[no-untyped-def]
    """Replace locked joints' rows by their given q'', and move its torque on others to `load`."""
    for i in range(len(load)):
        if locked[i]:
            for j in range(len(load)):
                load[j] -= M[j, i] * q_dd[i]
                M[i, j] = M[j, i] = 0.0
            M[i, i], load[i] = 1.0, q_dd[i]


@njit(cache=True, error_model="numpy")
def _accelerate(M, load, q_dd):  # type: ignore[no-untyped-def]
    """Solve M q'' = load by M = L D L'; False where M is not > 0.

    M then holds L below its diagonal, 1 / D on it, and D L' above.
    """
    N = len(load)
    for i in range(N):
        pivot = M[i, i]
        for j in range(i):
            total = M[i, j]
            for k in range(j):
                total -= M[k, i] * M[j, k]
            M[j, i], M[i, j] = total, total * M[j, j]
        for j in range(i):
            pivot -= M[j, i] * M[i, j]
        if not pivot > 0.0:
            return False
        M[i, i] = 1.0 / pivot
    for i in range(N):
        q_dd[i] = load[i]
        for k in range(i):
            q_dd[i] -= M[i, k] * q_dd[k]
    for i in range(N - 1, -1, -1):
        q_dd[i] *= M[i, i]
        for k in range(i + 1, N):
            q_dd[i] -= M[k, i] * q_dd[k]
    return True


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


def _rates(t, y_at, dy_at, inputs_at, n, rate, locked_at, geometry_at, par_at, context, work):  # type: ignore[no-untyped-def]
    """Fill dy; return OK or why there is no derivative (see `analysis.simulation.equations`)."""
    N, terms = context[0], context[1]
    layout = carray(context, (5 + 4 * terms,))[2:]
    ends, hidden_ends = layout[: terms + 1], layout[terms + 1 : 2 * terms + 2]
    prepares, addresses = layout[2 * terms + 2 : 3 * terms + 2], layout[3 * terms + 2 :]
    size = 4 * N + hidden_ends[terms]
    y, dy, par = carray(y_at, (size,)), carray(dy_at, (size,)), carray(par_at, (ends[terms],))
    inputs = carray(inputs_at, (n, 3 + 4 * N))
    locked, geometry = carray(locked_at, (N,)), carray(geometry_at, (N, eq.COLUMNS))
    scratch = carray(work, (4 + 17 * N + N * N,))
    bench = scratch[:4]
    x = scratch[4 : 4 + X_ROWS * N].reshape((X_ROWS, N))
    out = scratch[4 + X_ROWS * N : 4 + 16 * N].reshape((OUT_ROWS, N))
    M, q_dd = (
        scratch[4 + 16 * N : 4 + 16 * N + N * N].reshape((N, N)),
        scratch[4 + 16 * N + N * N :],
    )
    if not _observe(t, y, inputs, rate, locked, geometry, bench, x, q_dd):
        return eq.LEFT_STROKE
    out[:] = 0.0
    M[:] = 0.0
    for phase in (PREPARE, CONTRIBUTE):
        for m in range(terms):
            if phase == CONTRIBUTE or prepares[m] != 0:
                z = slice(4 * N + hidden_ends[m], 4 * N + hidden_ends[m + 1])
                p = slice(ends[m], ends[m + 1])
                _call(addresses[m], phase, bench, x, y[z], par[p], out, M, dy[z])
    for i in range(N):
        if geometry[i, eq.GAIN] != 0.0:
            out[TORQUE, i] += geometry[i, eq.GAIN] * x[U, i]
            continue
        force = geometry[i, eq.AREA_CAP] * x[P_CAP, i] - geometry[i, eq.AREA_ROD] * x[P_ROD, i]
        out[TORQUE, i] += x[G, i] * force
    _impose(M, out[TORQUE], locked, q_dd)
    if not _accelerate(M, out[TORQUE], q_dd):
        return eq.BAD_INERTIA
    for i in range(N):
        if locked[i]:
            dy[i] = dy[N + i] = dy[2 * N + i] = dy[3 * N + i] = 0.0
            continue
        dy[i] = x[QD, i]
        dy[N + i] = q_dd[i]
        if geometry[i, eq.GAIN] != 0.0:
            dy[2 * N + i] = dy[3 * N + i] = 0.0
            continue
        cap, rod = geometry[i, eq.AREA_CAP] * x[SD, i], geometry[i, eq.AREA_ROD] * x[SD, i]
        dy[2 * N + i] = (out[FLOW_CAP, i] - cap) / out[COMP_CAP, i]
        dy[3 * N + i] = (out[FLOW_ROD, i] + rod) / out[COMP_ROD, i]
    return eq.OK


@functools.cache
def compiled_rates() -> Any:
    """Return the right-hand side compiled, or from numba's cache; it has an `address`."""
    return cfunc(eq.RATES_SIGNATURE, cache=True, error_model="numpy")(_rates)


def context(
    joints: int,
    terms: Sequence[Used],
    packed: Sequence[NDArray[np.float64]],
    hidden: Sequence[int],
) -> NDArray[np.int64]:
    """Return the integers that describe a model's terms to the right-hand side.

    `packed` are the packed values of each term, `hidden` its number of states.
    """
    ends, hidden_ends = np.cumsum([0, *map(len, packed)]), np.cumsum([0, *hidden])
    prepares = [int(used.term.prepares) for used in terms]
    addresses = [used.term.kernel.address for used in terms]
    numbers = [joints, len(terms), *ends, *hidden_ends, *prepares, *addresses]
    return np.array(numbers, dtype=np.int64)


def work_size(joints: int) -> int:
    """Return the length of the right-hand side's workspace."""
    return 4 + 17 * joints + joints * joints
