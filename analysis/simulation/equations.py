"""The interface between a right-hand side and its integrator: status, layout, C signature.

    status = rates(t, y, dy, inputs, n, rate, locked, geometry, par, context, work)

with pointers to contiguous data: `y` and `dy` the state [q (N), dq/dt (N), p_cap (N), p_rod (N),
hidden] and its derivative; `inputs` (n, 3 + 4 N) sampled at `rate`: p_s, temperature, u, q, q', q''
of locked joints, time since the record began; `locked` (N,) bytes; `geometry` (N, 10), columns
below; `par` the terms' packed values; `context` and `work` further data of the right-hand side. M
q'' = torques, and in each chamber (V/b) dp/dt = flow in - A ds/dt (cap), + A ds/dt (rod). A locked
joint follows its measured motion. An electric joint has its drive's torque, s = q, G = 1, and
pressures that stay zero.
"""

from __future__ import annotations

from typing import Final

from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

OK, LEFT_STROKE, NOT_FINITE, STEP_TOO_SMALL, BAD_INERTIA = range(5)

# Columns of `geometry`, one row per joint. GAIN is the drive's gain of an electric joint, 0 of a
# hydraulic one; OFFSET of an electric joint is the known angle of its zero.
PIN_A, PIN_C, MID, OFFSET, AREA_CAP, AREA_ROD, DEAD_CAP, DEAD_ROD, STROKE, GAIN = range(10)
COLUMNS: Final = 10

_DOUBLES = types.CPointer(types.float64)
RATES_SIGNATURE = types.int64(
    types.float64, _DOUBLES, _DOUBLES, _DOUBLES, types.int64, types.float64,
    types.CPointer(types.uint8), _DOUBLES, _DOUBLES, types.CPointer(types.int64), _DOUBLES,
)  # fmt: skip


@intrinsic
def call_rates(typing, address, t, y, dy, inputs, n, rate, locked, geometry, par, context, work):  # type: ignore[no-untyped-def]
    """Call the right-hand side at a machine address; pointers are given as integers."""
    numbers = [types.float64 if k in (0, 5) else types.int64 for k in range(11)]
    signature = types.int64(types.int64, *numbers)

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        double, int64 = ir.DoubleType(), ir.IntType(64)
        kinds = [context.get_value_type(kind) for kind in RATES_SIGNATURE.args]
        values = [
            builder.inttoptr(value, kind) if isinstance(kind, ir.PointerType) else value
            for value, kind in zip(args[1:], kinds, strict=True)
        ]
        assert all(v.type in (double, int64) or isinstance(v.type, ir.PointerType) for v in values)
        pointer = ir.FunctionType(int64, kinds).as_pointer()
        return builder.call(builder.inttoptr(args[0], pointer), values)

    return signature, generate


@njit(cache=True, error_model="numpy")
def evaluate(address, t, y, dy, inputs, rate, locked, geometry, par, context, work):  # type: ignore[no-untyped-def]
    """Fill dy (size,) from arrays; return the status."""
    return call_rates(
        address, t, y.ctypes.data, dy.ctypes.data, inputs.ctypes.data, inputs.shape[0], rate,
        locked.ctypes.data, geometry.ctypes.data, par.ctypes.data, context.ctypes.data,
        work.ctypes.data,
    )  # fmt: skip
