"""The plant's equations, compiled: oil, metering edges, seals, end stops, arm, pump and relief.

Glossary: cap (p) and rod (m) are the chambers; an edge is one metering edge of the spool; ahead
is a positive spool, astern a negative one; z is a volume's compression (the strain its oil would
have if it did not cavitate); theta are absolute angles. State of N joints, shape (5 N + 3,):
q, q rate, z cap, z rod, bristle (N each), z supply, z manifold, tank pressure. SI throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from math import asin, copysign, cos, exp, pi, sin, sqrt, tanh
from typing import Any, ParamSpec, TypeVar

import numba

from hil_sim.plant.kernel_data import ATMOSPHERE, LEAK_WIDENING

P = ParamSpec("P")
R = TypeVar("R")


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function`, which must not allocate arrays; NaN and infinity keep their meaning.

    Its arrays' references are not counted: counting views of rows took half of the plant's time.
    """
    compiled: Callable[P, R] = numba.njit(
        cache=True, _nrt=False, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"}
    )(function)
    return compiled


@jit
def pressure(z: float, bench: Any) -> float:
    """Return the gauge pressure [Pa] of oil with a trace of gas at compression z.

    z = p_abs / b - a p0 / p_abs solved for p_abs: b z when compressed, towards zero absolute (and
    never past it) when the volume is drawn apart; oil and gas are conserved.
    """
    gauge: float = bench.half_bulk * (z + sqrt(z * z + bench.trapped)) - ATMOSPHERE
    return gauge


@jit
def softening(z: float, bulk_ratio: float, bench: Any) -> float:
    """Return the ratio of the present bulk modulus to dp/dz of `pressure`.

    `bulk_ratio` is b(T)/b; entrained air adds V_g = a (p0 / p_abs)^(1/n) exp(-p / p_d) per volume
    of oil: a polytropic gas of exponent n (Wylie) that dissolves with rising pressure (Henry).
    """
    if bench.air <= 0.0:
        return bulk_ratio
    root = sqrt(z * z + bench.trapped)
    absolute = bench.half_bulk * (z + root) + 1e-3
    stiff = absolute / root
    n = bench.air_exponent
    free = bench.air * (ATMOSPHERE / absolute) ** (1.0 / n) * exp(-absolute / bench.air_dissolution)
    gas = free * (1.0 / (n * absolute) + 1.0 / bench.air_dissolution)
    ratio: float = bulk_ratio / (1.0 + bulk_ratio * stiff * gas)
    return ratio


@jit
def orifice(drop: float, laminar: float) -> float:
    """Return drop / (drop^2 + laminar^2)^(1/4): a square root that is linear near zero."""
    return drop / sqrt(sqrt(drop * drop + laminar * laminar))


@jit
def edge_root(drop: float, laminar: float, form: float) -> float:
    """Return the flow of an edge over gain and opening [Pa^0.5], laminar below the drop `laminar`.

    `form` 0: `orifice`. 1: a cubic below, the square root above, of one slope where they meet. 2: a
    flow coefficient of tanh(2 Re / Re_t), Re in proportion to the drop's root (McCloy and Martin,
    1980).
    """
    if form == 0.0:
        return orifice(drop, laminar)
    size = abs(drop)
    root: float = sqrt(size)
    share = size / laminar
    if form == 2.0:
        root *= tanh(2.0 * sqrt(share))
    elif share < 1.0:
        root = sqrt(laminar) * share * (1.25 - 0.25 * share * share)
    return copysign(root, drop)


@jit
def opening(travel: float, lap: float, rounding: float, notch: float) -> float:
    """Return one edge's opening [V]; sharp at zero rounding, lap > 0 overlaps, < 0 underlaps.

    A corner worn round over +- rounding of travel: a parabola there that meets both straight lines.
    A triangular notch of depth `notch` [V] opens as the square of the travel, then as the edge.
    """
    past = travel - lap
    if notch > 0.0:
        if past <= 0.0:
            return 0.0
        return past * past / (2.0 * notch) if past < notch else past - 0.5 * notch
    if abs(past) >= rounding:
        return max(past, 0.0)
    return (past + rounding) * (past + rounding) / (4.0 * rounding)


@jit
def contact(s: float, v: float, joint: Any) -> float:
    """Return the end stops' force against extension [N] (Hunt and Crossley, exponent 3/2)."""
    penetration = abs(s) - joint.half_stroke
    if penetration <= 0.0:
        return 0.0
    side = copysign(1.0, s)
    force = joint.contact_stiffness * penetration * sqrt(penetration)
    contact_force: float = side * force * max(1.0 + joint.contact_damping * v * side, 0.0)
    return contact_force


@jit
def friction_level(s: float, v: float, p_cap: float, p_rod: float, joint: Any) -> float:
    """Return the steady friction force [N], above zero, in the direction of v."""
    force = joint.friction_plus if v >= 0.0 else joint.friction_minus
    ratio = v / joint.stribeck_speed
    force += joint.stribeck * exp(-ratio * ratio)
    force += joint.friction_pressure * max(p_cap + p_rod, 0.0)
    force = max(force * (1.0 + joint.friction_taper * s), 1e-3 * joint.friction_scale)
    return float(force)


@jit
def sliding(s: float, v: float, p_cap: float, p_rod: float, joint: Any) -> float:
    """Return seal friction without memory [N], F being `friction_level`, smooth over a speed width.

    F tanh(v / width), or F v / sqrt(v^2 + width^2) where `friction_corner` is set.
    """
    x = v / joint.friction_width
    share = x / sqrt(1.0 + x * x) if joint.friction_corner > 0.0 else tanh(x)
    force: float = friction_level(s, v, p_cap, p_rod, joint) * share
    return force


@jit
def bristle(deflection: float, s: float, v: float, p_cap: float, p_rod: float, joint: Any) -> Any:
    """Return (seal friction [N], bristle rate [m/s]) after LuGre (Canudas de Wit 1995).

    Its relaxation rate |v| sigma0 / g is bounded at `bristle_limit`, so that the fixed step holds
    at any speed; the steady force stays g(v) sign(v).
    """
    relax = abs(v) * joint.bristle_stiffness / friction_level(s, v, p_cap, p_rod, joint)
    rate = (v - relax * deflection) / (1.0 + relax / joint.bristle_limit)
    return joint.bristle_stiffness * deflection + joint.bristle_damping * rate, rate


@jit
def drag(v: float, lever: float, joint: Any) -> float:
    """Return viscous friction beyond the joint's against extension [N], by direction.

    At the piston, its film thinning with the shear where `drag_thinning` [s/m] is set; or at the
    joint, where `drag_lever` [m] is the lever at which the slopes are those of the piston.
    """
    slope = joint.drag_plus if v > 0.0 else joint.drag_minus
    if joint.drag_lever > 0.0:
        ratio = joint.drag_lever / lever
        return float(slope * v * ratio * ratio)
    return float(slope * v / (1.0 + joint.drag_thinning * abs(v)))


@jit
def wave(cycles: float, form: float) -> float:
    """Return a periodic torque over its amplitude, after `cycles` cycles."""
    turn = sin(2.0 * pi * cycles)
    if form == 1.0:
        return 2.0 / pi * asin(turn)
    return turn**5 if form == 2.0 else turn


@jit
def relief(p: float, bench: Any) -> float:
    """Return the relief valve's flow [m^3/s]: a slope above cracking, rounded at cracking."""
    excess = p - bench.relief_crack
    rounding = bench.relief_rounding
    flow: float = 0.5 * bench.relief_slope * (excess + sqrt(excess * excess + rounding * rounding))
    return flow


@jit
def port_flows(
    x: float,
    s: float,
    p_cap: float,
    p_rod: float,
    port: float,
    tank: float,
    j: Any,
    lam: float,
    form: float,
) -> Any:
    """Return the flows [m^3/s] into cap and rod, out of the supply and into the tank line.

    C x sqrt(dp) on every open edge (NOTES, "Fluid", with a laminar region), and the leaks.
    """
    q_cap = 0.0
    if j.leak_internal > 0.0:
        across, worn = p_rod - p_cap, s / j.leak_length
        q_cap = j.leak_internal * exp(-worn * worn) * across * (1.0 + LEAK_WIDENING * abs(across))
    q_rod = -q_cap - j.leak_rod * (p_rod - tank)
    q_cap -= j.leak_cap * (p_cap - tank)
    demand, returned = 0.0, 0.0
    ahead = opening(x, j.lap_ahead, j.rounding, j.notch)
    if ahead > 0.0:
        demand = j.c_pp * ahead * edge_root(port - p_cap, lam, form)
        returned = j.c_mp * ahead * edge_root(p_rod - tank, lam, form)
        q_cap, q_rod = q_cap + demand, q_rod - returned
    astern = opening(-x, j.lap_astern, j.rounding, j.notch)
    if astern > 0.0:
        feed = j.c_mm * astern * edge_root(port - p_rod, lam, form)
        drain = j.c_pm * astern * edge_root(p_cap - tank, lam, form)
        q_cap, q_rod = q_cap - drain, q_rod + feed
        demand, returned = demand + feed, returned + drain
    return q_cap, q_rod, demand, returned


@jit
def supply_rates(
    y: Any, port: float, demand: float, returned: float, bulk_ratio: float, bench: Any, dy: Any
) -> None:
    """Write the rates of supply, manifold and tank pressure, the last three of the state.

    Pump = relief + line; a turbulent line to the valves where there is one; the tank's pressure
    follows the square of the returned flow with the line's lag.
    """
    first = len(y) - 3
    p_supply, line = pressure(y[first], bench), demand
    dy[first + 1] = 0.0
    if bench.line_gain > 0.0:
        drop = p_supply - port
        line = bench.line_gain * orifice(drop, bench.laminar)
        if bench.line_laminar > 0.0:
            line = bench.line_laminar * drop
        ratio = softening(y[first + 1], bulk_ratio, bench)
        dy[first + 1] = ratio * (line - demand) / bench.manifold_volume
    ratio = softening(y[first], bulk_ratio, bench)
    dy[first] = ratio * (bench.pump - relief(p_supply, bench) - line) / bench.supply_volume
    back = bench.tank_pressure + bench.tank_laminar * returned
    back += bench.tank_resistance * returned * abs(returned)
    dy[first + 2] = (back - y[first + 2]) / bench.tank_lag


@jit
def angular(theta: Any, torque: Any, rate: Any, joints: Any, inertia: Any, m: Any) -> None:
    """Solve for the absolute accelerations of a planar chain, left in `torque`.

    R_ij cos(th_i - th_j) th_j'' + R_ij sin(th_i - th_j) th_j'^2 + W_i g sin th_i = tau_i - tau_i+1
    (Lagrange of T and V in NOTES, "N DOF planar chain"), by L D L^T in place.
    theta holds sine and cosine, (2, N); m is work, (N, N).
    """
    n = len(joints)
    for i in range(n):
        row_torque = torque[i] - joints[i].weight * theta[0, i]
        if i + 1 < n:
            row_torque -= torque[i + 1]
        for k in range(i):
            cosine_ik = theta[1, i] * theta[1, k] + theta[0, i] * theta[0, k]
            R_sine = inertia[i, k] * (theta[0, i] * theta[1, k] - theta[1, i] * theta[0, k])
            m[i, k] = inertia[i, k] * cosine_ik
            row_torque -= R_sine * rate[k] * rate[k]
            torque[k] += R_sine * rate[i] * rate[i]
        torque[i] = row_torque
    # m[i, i] keeps 1 / D_i, m[i, k] first L_ik D_k, then L_ik.
    for i in range(n):
        diagonal, row_torque = inertia[i, i], torque[i]
        for k in range(i):
            scaled = m[i, k]
            for r in range(k):
                scaled -= m[i, r] * m[k, r] / m[r, r]
            m[i, k] = scaled * m[k, k]
            diagonal -= m[i, k] * scaled
            row_torque -= m[i, k] * torque[k]
        m[i, i], torque[i] = 1.0 / diagonal, row_torque
    for i in range(n - 1, -1, -1):
        row_torque = torque[i] * m[i, i]
        for k in range(i + 1, n):
            row_torque -= m[k, i] * torque[k]
        torque[i] = row_torque


@jit
def rates(
    y: Any, spool: Any, bulk_ratio: float, joints: Any, bench: Any, inertia: Any, w: Any, dy: Any
) -> None:
    """Write the state's rate at effective openings `spool`, (N,) [V], into dy.

    `bulk_ratio` is b(T)/b; w is work, (N + 4, N).
    """
    n = len(joints)
    theta, torque, turns, m = w[n : n + 2], w[n + 2], w[n + 3], w[:n]
    port = pressure(y[5 * n + 1 if bench.line_gain > 0.0 else 5 * n], bench)
    tank, demand, returned = y[5 * n + 2], 0.0, 0.0
    sine, cosine, turn = bench.sin_slope, bench.cos_slope, 0.0
    for i in range(n):
        j = joints[i]
        sin_b, cos_b = sin(y[i] + j.offset), cos(y[i] + j.offset)
        length = sqrt(j.pins - 2.0 * j.product * cos_b)
        lever = j.product * sin_b / length
        s, v = length - j.mid_length, lever * y[n + i]
        p_cap, p_rod = pressure(y[2 * n + i], bench), pressure(y[3 * n + i], bench)

        q_cap, q_rod, drawn, drained = port_flows(
            spool[i], s, p_cap, p_rod, port, tank, j, bench.laminar, bench.laminar_form
        )
        demand, returned = demand + drawn, returned + drained
        ratio = softening(y[2 * n + i], bulk_ratio, bench)
        dy[2 * n + i] = ratio * (q_cap - j.cap_area * v) / (j.cap_volume + s * j.cap_area)
        ratio = softening(y[3 * n + i], bulk_ratio, bench)
        dy[3 * n + i] = ratio * (q_rod + j.rod_area * v) / (j.rod_volume - s * j.rod_area)

        force = j.cap_area * p_cap - j.rod_area * p_rod - contact(s, v, j)
        dy[4 * n + i] = 0.0
        if j.friction_width > 0.0:
            force -= sliding(s, v, p_cap, p_rod, j)
        elif j.bristle_stiffness > 0.0:
            friction, dy[4 * n + i] = bristle(y[4 * n + i], s, v, p_cap, p_rod, j)
            force -= friction
        if j.drag_plus != j.drag_minus:
            force -= drag(v, lever, j)
        deflection = y[i] - j.spring_rest
        spring = j.spring * deflection * (1.0 + j.spring_hardening * deflection * deflection)
        torque[i] = lever * force - j.viscous * y[n + i] - spring + j.torque_offset + j.wave_now

        dy[i] = y[n + i]
        sin_q = sin_b * j.cos_offset - cos_b * j.sin_offset
        cos_q = cos_b * j.cos_offset + sin_b * j.sin_offset
        sine, cosine = sine * cos_q + cosine * sin_q, cosine * cos_q - sine * sin_q
        turn += y[n + i]
        theta[0, i], theta[1, i], turns[i] = sine, cosine, turn
    angular(theta, torque, turns, joints, inertia, m)
    for i in range(n):
        dy[n + i] = torque[i] - (torque[i - 1] if i > 0 else 0.0)
    supply_rates(y, port, demand, returned, bulk_ratio, bench, dy)
