"""The free run by SUNDIALS' CVODES, with C code that CasADi generates from the same equations.

CasADi generates the right-hand side and its Jacobian as C code, `zig cc` compiles them, and CVODES
is called once for all samples. Needs the extra `bench` (casadi, ziglang).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import chdir, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STATES: Final = 8
COMPILER: Final = f"{sys.executable} -m ziglang cc"
MAX_STEPS: Final = 10_000_000


def available() -> bool:
    """Return whether the packages of the extra `bench` are installed."""
    return find_spec("casadi") is not None and find_spec("ziglang") is not None


def solver(
    p: Array, inputs: Array, rate: float, scale: Array, folder: Path | None
) -> Callable[[float, Array], Callable[[], Array]]:
    """Return a function of tolerance and start (8,) that prepares a free run: () to states (n, 8).

    `p`: `hand_fused.constants`. `inputs` (n, 3): both spools [V] and the supply [Pa], sampled at
    `rate` [Hz], linear between samples. `scale` (8,): absolute error of each state at a tolerance
    of one. With a `folder` the C code is compiled there; without one CasADi interprets it.
    """
    import casadi as ca

    grid = np.arange(len(inputs)) / rate
    y, w = ca.SX.sym("y", STATES), ca.SX.sym("w", 3)
    rates = ca.Function("rates", [y, w], [ca.vertcat(*_rates(ca, y, w, p))])
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


def _rates(ca: Any, y: Any, w: Any, p: Array) -> Sequence[Any]:
    """Return dy/dt of y = (q1, q2, q1', q2', cap1, cap2, rod1, rod2) as expressions.

    The equations are those of `hand_fused`; `w` are both spools and the supply.
    """
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
        into = ca.if_else(u > 0.0, pp * _root(ca, supply - cap[i]) * u, pm * _root(ca, cap[i]) * u)
        out = ca.if_else(u > 0.0, mp * _root(ca, rod[i]) * u, mm * _root(ca, supply - rod[i]) * u)
        speed = slope[i] * v[i]
        volume = pipe_cap + (half + piston[i]) * area_cap
        flow_cap.append((into - area_cap * speed) / (p[7] * volume))
        volume = pipe_rod + (half - piston[i]) * area_rod
        flow_rod.append((area_rod * speed - out) / (p[7] * volume))
    return (
        *v, (M22 * tau1 - M12 * tau2) / det, (M11 * tau2 - M12 * tau1) / det, *flow_cap, *flow_rod,
    )  # fmt: skip


def _root(ca: Any, drop: Any) -> Any:
    return ca.sign(drop) * ca.sqrt(ca.fabs(drop))
