"""Reference solvers for the speed of a free run: by hand and by CVODES, for two joints only.

Both solve the paper's model with both joints free and use no code of the simulation.

By hand: the state in local variables, with the same Runge-Kutta pair, step control and output as
the simulation. A simulation of any model can at best be as fast.

SUNDIALS' CVODES: CasADi generates the right-hand side and its Jacobian as C code, `zig cc` compiles
them, and CVODES is called once for all samples. Needs the extra `bench` (casadi, ziglang).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir, nullcontext
from pathlib import Path
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rig.model.rig import Rig

Array = NDArray[np.float64]

STATES: Final = 8
COMPILER: Final = f"{sys.executable} -m ziglang cc"
MAX_STEPS: Final = 10_000_000


def constants(rig: Rig, values: Mapping[str, float]) -> Array:
    """Return the parameters (16 + 2 x 9,) in the order in which `_rates` reads them."""
    g = rig.gravity
    names = ("M1", "M2", "R12", "Fv1", "Fv2")
    gains = [values[f"C_{edge}_{i}"] for i in (1, 2) for edge in ("pp", "pm", "mp", "mm")]
    out = [*(values[name] for name in names), g * values["W1"], g * values["W2"]]
    out += [1.0 / values["b"], *gains]
    for joint in rig.joints:
        link, cylinder = joint.linkage, joint.cylinder
        a, c = link.base_pin, link.arm_pin
        out += [a * a + c * c, a * c, link.mid_length, link.offset]
        out += [cylinder.cap_area, cylinder.rod_area, cylinder.cap_pipe_volume]
        out += [cylinder.rod_pipe_volume, 0.5 * cylinder.stroke]
    return np.array(out)


@njit(error_model="numpy", inline="always")
def _root(drop):  # type: ignore[no-untyped-def]
    return math.sqrt(drop) if drop >= 0.0 else -math.sqrt(-drop)


@njit(error_model="numpy", inline="always")
def _linkage(q, squares, product, mid, offset):  # type: ignore[no-untyped-def]
    """Return the piston position l [m] and dl/dq."""
    length = math.sqrt(squares - 2.0 * product * math.cos(q + offset))
    return length - mid, product * math.sin(q + offset) / length


@njit(error_model="numpy")
def _rates(t, y, dy, u, supply, rate, p):  # type: ignore[no-untyped-def]
    """Fill dy/dt of y = (q1, q2, q1', q2', cap1, cap2, rod1, rod2)."""
    q1, q2, v1, v2, cap1, cap2, rod1, rod2 = y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7]
    position = min(max(t * rate, 0.0), len(supply) - 1.0)
    low = min(int(position), len(supply) - 2)
    w = position - low
    p_s = supply[low] + w * (supply[low + 1] - supply[low])
    u1 = u[low, 0] + w * (u[low + 1, 0] - u[low, 0])
    u2 = u[low, 1] + w * (u[low + 1, 1] - u[low, 1])
    s1, G1 = _linkage(q1, p[16], p[17], p[18], p[19])
    s2, G2 = _linkage(q2, p[25], p[26], p[27], p[28])
    c, s = p[2] * math.cos(q2), p[2] * math.sin(q2)
    M11, M12, M22 = p[0] + 2.0 * c, p[1] + c, p[1]
    v12 = v1 + v2
    weight_torque = p[6] * math.sin(q1 + q2)
    tau2 = G2 * (p[29] * cap2 - p[30] * rod2) - p[4] * v2 - weight_torque - s * v1 * v1
    tau1 = (
        G1 * (p[20] * cap1 - p[21] * rod1) - p[3] * v1 - weight_torque - p[5] * math.sin(q1)
        + s * (v12 * v12 - v1 * v1)
    )  # fmt: skip
    det = M11 * M22 - M12 * M12
    a1, a2 = (M22 * tau1 - M12 * tau2) / det, (M11 * tau2 - M12 * tau1) / det
    if u1 > 0.0:
        in1, out1 = p[8] * _root(p_s - cap1) * u1, p[10] * _root(rod1) * u1
    else:
        in1, out1 = p[9] * _root(cap1) * u1, p[11] * _root(p_s - rod1) * u1
    if u2 > 0.0:
        in2, out2 = p[12] * _root(p_s - cap2) * u2, p[14] * _root(rod2) * u2
    else:
        in2, out2 = p[13] * _root(cap2) * u2, p[15] * _root(p_s - rod2) * u2
    sd1, sd2 = G1 * v1, G2 * v2
    dy[0], dy[1], dy[2], dy[3] = v1, v2, a1, a2
    dy[4] = (in1 - p[20] * sd1) / (p[7] * (p[22] + (p[24] + s1) * p[20]))
    dy[5] = (in2 - p[29] * sd2) / (p[7] * (p[31] + (p[33] + s2) * p[29]))
    dy[6] = (p[21] * sd1 - out1) / (p[7] * (p[23] + (p[24] - s1) * p[21]))
    dy[7] = (p[30] * sd2 - out2) / (p[7] * (p[32] + (p[33] - s2) * p[30]))


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
_C = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_E = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
_D = (
    -12715105075 / 11282082432, 0.0, 87487479700 / 32700410799, -10690763975 / 1880347072,
    701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
)  # fmt: skip


@njit(error_model="numpy")
def free_run(start, u, supply, rate, p, rtol, atol, out):  # type: ignore[no-untyped-def]  # noqa: PLR0912  unrolled
    """Fill out (n, 12) with states, piston positions and velocities.

    `start` (8,): q, q', p_cap, p_rod. `u` (n, 2) and `supply` (n,) are sampled at `rate`. The
    root mean square error of a step stays below `atol` (8,) + `rtol` |y|.
    """
    n = len(out)
    k1, k2, k3, k4, k5, k6, k7 = (
        np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8),
    )  # fmt: skip
    y, z = start.copy(), np.empty(8)
    r2, r3, r4, r5 = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    out[0, :8] = y
    t, h, filled = 0.0, 0.2 / rate, 1
    end = (n - 1) / rate + 1e-9
    _rates(t, y, k1, u, supply, rate, p)
    failed = False
    while filled < n:
        h = min(h, end - t)
        for j in range(8):
            z[j] = y[j] + h * (_A[0, 0] * k1[j])
        _rates(t + _C[0] * h, z, k2, u, supply, rate, p)
        for j in range(8):
            z[j] = y[j] + h * (_A[1, 0] * k1[j] + _A[1, 1] * k2[j])
        _rates(t + _C[1] * h, z, k3, u, supply, rate, p)
        for j in range(8):
            z[j] = y[j] + h * (_A[2, 0] * k1[j] + _A[2, 1] * k2[j] + _A[2, 2] * k3[j])
        _rates(t + _C[2] * h, z, k4, u, supply, rate, p)
        for j in range(8):
            z[j] = y[j] + h * (
                _A[3, 0] * k1[j] + _A[3, 1] * k2[j] + _A[3, 2] * k3[j] + _A[3, 3] * k4[j]
            )
        _rates(t + _C[3] * h, z, k5, u, supply, rate, p)
        for j in range(8):
            z[j] = y[j] + h * (
                _A[4, 0] * k1[j] + _A[4, 1] * k2[j] + _A[4, 2] * k3[j] + _A[4, 3] * k4[j]
                + _A[4, 4] * k5[j]
            )  # fmt: skip
        _rates(t + h, z, k6, u, supply, rate, p)
        for j in range(8):
            z[j] = y[j] + h * (
                _A[5, 0] * k1[j] + _A[5, 2] * k3[j] + _A[5, 3] * k4[j] + _A[5, 4] * k5[j]
                + _A[5, 5] * k6[j]
            )  # fmt: skip
        _rates(t + h, z, k7, u, supply, rate, p)
        error = 0.0
        for j in range(8):
            e = _E[0] * k1[j] + _E[2] * k3[j] + _E[3] * k4[j] + _E[4] * k5[j] + _E[5] * k6[j]
            e += _E[6] * k7[j]
            error += (h * e / (atol[j] + rtol * max(abs(y[j]), abs(z[j])))) ** 2
        error = math.sqrt(error / 8.0)
        if error > 1.0:
            h *= max(0.2, 0.9 * error**-0.2)
            failed = True
            continue
        for j in range(8):
            r2[j] = z[j] - y[j]
            r3[j] = h * k1[j] - r2[j]
            r4[j] = r2[j] - h * k7[j] - r3[j]
            r5[j] = h * (
                _D[0] * k1[j] + _D[2] * k3[j] + _D[3] * k4[j] + _D[4] * k5[j] + _D[5] * k6[j]
                + _D[6] * k7[j]
            )  # fmt: skip
        while filled < n and filled / rate <= t + h + 1e-12:
            a = min((filled / rate - t) / h, 1.0)
            b = 1.0 - a
            for j in range(8):
                out[filled, j] = y[j] + a * (r2[j] + b * (r3[j] + a * (r4[j] + b * r5[j])))
            filled += 1
        t += h
        y[:], k1[:] = z, k7
        h *= min(0.9 * max(error, 1e-8) ** -0.2, 1.0 if failed else 5.0)
        failed = False
    for k in range(n):
        for i in range(2):
            place, slope = _linkage(
                out[k, i], p[16 + 9 * i], p[17 + 9 * i], p[18 + 9 * i], p[19 + 9 * i]
            )
            out[k, 8 + i], out[k, 10 + i] = place, slope * out[k, 2 + i]


def cvodes_solver(
    p: Array, inputs: Array, rate: float, scale: Array, folder: Path | None
) -> Callable[[float, Array], Callable[[], Array]]:
    """Return a function of tolerance and start (8,) that prepares a free run: () to states (n, 8).

    `p`: `constants`. `inputs` (n, 3): both spools [V] and the supply [Pa], sampled at `rate` [Hz],
    linear between samples. `scale` (8,): absolute error of each state at a tolerance of one. With a
    `folder` the C code is compiled there; without one CasADi interprets it.
    """
    import casadi as ca

    grid = np.arange(len(inputs)) / rate
    y, w = ca.SX.sym("y", STATES), ca.SX.sym("w", 3)
    rates = ca.Function("rates", [y, w], [ca.vertcat(*_symbolic_rates(ca, y, w, p))])
    state, t = ca.MX.sym("state", STATES), ca.MX.sym("t")
    interpolated = ca.interpolant(
        "inputs", "linear", [grid.tolist()], inputs.ravel().tolist(), {"lookup_mode": ["exact"]}
    )
    equations = {"x": state, "t": t, "ode": rates(state * scale, interpolated(t)) / scale}
    options: dict[str, Any] = {"max_num_steps": MAX_STEPS}
    if folder is not None:
        # The caller removes the folder.
        compiling = {"compiler": COMPILER, "linker": COMPILER, "flags": ["-O3"], "cleanup": False}
        options |= {"jit": True, "compiler": "shell", "jit_cleanup": False}
        options["jit_options"] = compiling

    def at(tolerance: float, start: Array) -> Callable[[], Array]:
        with_tolerance = {**options, "abstol": tolerance, "reltol": tolerance}
        # CasADi writes into the current folder.
        with nullcontext() if folder is None else chdir(folder):
            run = ca.integrator("run", "cvodes", equations, 0.0, grid, with_tolerance)
        return lambda: np.asarray(run(x0=start / scale)["xf"]).T * scale

    return at


def _symbolic_rates(ca: Any, y: Any, w: Any, p: Array) -> Sequence[Any]:
    """Return dy/dt of y = (q1, q2, q1', q2', cap1, cap2, rod1, rod2) as expressions.

    The equations are those of `_rates`; `w` are both spools and the supply.
    """

    def root(drop: Any) -> Any:
        return ca.sign(drop) * ca.sqrt(ca.fabs(drop))

    q, v, cap, rod = ([y[k], y[k + 1]] for k in (0, 2, 4, 6))
    spool, supply = [w[0], w[1]], w[2]
    piston, slope = [], []
    for i in range(2):
        squares, product, mid, offset = p[16 + 9 * i : 20 + 9 * i]
        length = ca.sqrt(squares - 2.0 * product * ca.cos(q[i] + offset))
        piston.append(length - mid)
        slope.append(product * ca.sin(q[i] + offset) / length)
    force = [p[20 + 9 * i] * cap[i] - p[21 + 9 * i] * rod[i] for i in range(2)]
    c, s = p[2] * ca.cos(q[1]), p[2] * ca.sin(q[1])
    M11, M12, M22 = p[0] + 2.0 * c, p[1] + c, p[1]
    weight_torque = p[6] * ca.sin(q[0] + q[1])
    tau2 = slope[1] * force[1] - p[4] * v[1] - weight_torque - s * v[0] ** 2
    tau1 = slope[0] * force[0] - p[3] * v[0] - weight_torque - p[5] * ca.sin(q[0])
    tau1 += s * ((v[0] + v[1]) ** 2 - v[0] ** 2)
    det = M11 * M22 - M12 * M12
    flow_cap, flow_rod = [], []
    for i in range(2):
        pp, pm, mp, mm, u = *p[8 + 4 * i : 12 + 4 * i], spool[i]
        area_cap, area_rod, pipe_cap, pipe_rod, half = p[20 + 9 * i : 25 + 9 * i]
        into = ca.if_else(u > 0.0, pp * root(supply - cap[i]) * u, pm * root(cap[i]) * u)
        out = ca.if_else(u > 0.0, mp * root(rod[i]) * u, mm * root(supply - rod[i]) * u)
        speed = slope[i] * v[i]
        volume = pipe_cap + (half + piston[i]) * area_cap
        flow_cap.append((into - area_cap * speed) / (p[7] * volume))
        volume = pipe_rod + (half - piston[i]) * area_rod
        flow_rod.append((area_rod * speed - out) / (p[7] * volume))
    return (
        *v, (M22 * tau1 - M12 * tau2) / det, (M11 * tau2 - M12 * tau1) / det, *flow_cap, *flow_rod,
    )  # fmt: skip
