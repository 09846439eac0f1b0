"""The plant's equations and its tick loop, compiled.

Everything compiled stands in this one file: the compiler's cache follows a file's own date only.
Glossary: cap (p) and rod (m) are the chambers; an edge is one metering edge of the spool; z is a
volume's compression (the strain its oil would have if it did not cavitate); theta are absolute
angles. State vector of N joints, shape (5 N + 3,):
q, q rate, z cap, z rod, bristle (N each), z supply, z manifold, tank pressure.
Spool state, shape (3, N): LVDT voltage, its rate, effective opening.
"""

from __future__ import annotations

from collections.abc import Callable
from math import copysign, cos, exp, sin, sqrt
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np

from hil_sim.kernel_data import ATMOSPHERE, KIND, LEAK_WIDENING

P = ParamSpec("P")
R = TypeVar("R")


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function`; NaN and infinity keep their meaning."""
    compiled: Callable[P, R] = numba.njit(
        cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"}
    )(function)
    return compiled


_PISTON = KIND["piston"]
_CAP, _ROD = KIND["cap_pressure"], KIND["rod_pressure"]
_SPOOL, _SUPPLY = KIND["spool"], KIND["supply_pressure"]


@jit
def pressure(z: float, bench: Any) -> float:
    """Return the gauge pressure [Pa] of oil with a trace of gas at compression z.

    z = p_abs / b - a p0 / p_abs solved for p_abs: b z when compressed, towards zero absolute (and
    never past it) when the volume is drawn apart; oil and gas are conserved.
    """
    return bench.half_bulk * (z + sqrt(z * z + bench.trapped)) - ATMOSPHERE


@jit
def softening(z: float, warmth: float, bench: Any) -> float:
    """Return the ratio of the present bulk modulus to dp/dz of `pressure`.

    `warmth` is b(T)/b; entrained air adds V_g = a (p0 / p_abs) exp(-p / p_d) per volume of oil: an
    isothermal gas (Wylie) that dissolves as the pressure rises (Henry's law).
    """
    if bench.air <= 0.0:
        return warmth
    root = sqrt(z * z + bench.trapped)
    absolute = bench.half_bulk * (z + root) + 1e-3
    stiff = absolute / root
    free = bench.air * ATMOSPHERE / absolute * exp(-absolute / bench.air_dissolution)
    gas = free * (1.0 / absolute + 1.0 / bench.air_dissolution)
    return warmth / (1.0 + warmth * stiff * gas)


@jit
def orifice(drop: float, laminar: float) -> float:
    """Return drop / (drop^2 + laminar^2)^(1/4): a square root that is linear near zero."""
    return drop / sqrt(sqrt(drop * drop + laminar * laminar))


@jit
def opening(travel: float, lap: float, rounding: float) -> float:
    """Return one edge's opening [V]; sharp at zero rounding, lap > 0 overlaps, < 0 underlaps."""
    past = travel - lap
    if rounding == 0.0:
        return max(past, 0.0)
    return 0.5 * (past + sqrt(past * past + rounding * rounding))


@jit
def contact(s: float, v: float, joint: Any) -> float:
    """Return the end stops' force against extension [N] (Hunt and Crossley, exponent 3/2)."""
    over = abs(s) - joint.half_stroke
    if over <= 0.0:
        return 0.0
    side = copysign(1.0, s)
    force = joint.contact_stiffness * over * sqrt(over)
    return side * force * max(1.0 + joint.contact_damping * v * side, 0.0)


@jit
def bristle(deflection: float, v: float, p_cap: float, p_rod: float, joint: Any) -> Any:
    """Return (seal friction [N], bristle rate [m/s]) after LuGre (Canudas de Wit 1995).

    Its relaxation rate |v| sigma0 / g is bounded at `bristle_limit`, so that the fixed step holds
    at any speed; the steady force stays g(v) sign(v).
    """
    level = joint.friction_plus if v >= 0.0 else joint.friction_minus
    ratio = v / joint.stribeck_speed
    level += joint.stribeck * exp(-ratio * ratio)
    level += joint.friction_pressure * max(p_cap + p_rod, 0.0)
    level = max(level, 1e-3 * joint.friction_scale)
    relax = abs(v) * joint.bristle_stiffness / level
    rate = (v - relax * deflection) / (1.0 + relax / joint.bristle_limit)
    return joint.bristle_stiffness * deflection + joint.bristle_damping * rate, rate


@jit
def relief(p: float, bench: Any) -> float:
    """Return the relief valve's flow [m^3/s]: a slope above cracking, rounded at its foot."""
    over = p - bench.relief_crack
    return 0.5 * bench.relief_slope * (over + sqrt(over * over + bench.relief_rounding**2))


@jit
def angular(theta: Any, torque: Any, rate: Any, joints: Any, inertia: Any, m: Any) -> None:
    """Solve for the absolute accelerations of a planar chain, left in `torque`.

    R_ij cos(th_i - th_j) th_j'' + R_ij sin(th_i - th_j) th_j'^2 + W_i g sin th_i = tau_i - tau_i+1
    (Lagrange of T and V in NOTES, "N DOF planar chain"), by L D L^T in place.
    theta holds sine and cosine, (2, N); m is work, (N, N).
    """
    n = len(joints)
    for i in range(n):
        if i + 1 < n:
            torque[i] -= torque[i + 1]
        torque[i] -= joints[i].weight * theta[0, i]
    for i in range(n):
        m[i, i] = inertia[i, i]
        for k in range(i):
            m[i, k] = inertia[i, k] * (theta[1, i] * theta[1, k] + theta[0, i] * theta[0, k])
            twist = inertia[i, k] * (theta[0, i] * theta[1, k] - theta[1, i] * theta[0, k])
            torque[i] -= twist * rate[k] * rate[k]
            torque[k] += twist * rate[i] * rate[i]
    for i in range(n):
        for k in range(i):
            for r in range(k):
                m[i, k] -= m[i, r] * m[k, r] * m[r, r]
            m[i, k] /= m[k, k]
            m[i, i] -= m[i, k] * m[i, k] * m[k, k]
            torque[i] -= m[i, k] * torque[k]
    for i in range(n - 1, -1, -1):
        torque[i] /= m[i, i]
        for k in range(i + 1, n):
            torque[i] -= m[k, i] * torque[k]


@jit
def rates(
    y: Any, spool: Any, warmth: float, joints: Any, bench: Any, inertia: Any, w: Any, dy: Any
) -> None:
    """Write the state's rate at effective openings `spool`, (N,) [V], into dy; w is work.

    w, shape (N + 4, N), keeps afterwards in rows N.. : sine and cosine of theta, joint torque then
    acceleration, absolute rate.
    """
    n = len(joints)
    theta, torque, rate, m = w[n : n + 2], w[n + 2], w[n + 3], w[:n]
    p_supply = pressure(y[5 * n], bench)
    lined = bench.line_gain > 0.0
    port = pressure(y[5 * n + 1], bench) if lined else p_supply
    tank = y[5 * n + 2]
    demand, returned = 0.0, 0.0
    sine, cosine, turn = bench.sin_slope, bench.cos_slope, 0.0
    for i in range(n):
        j = joints[i]
        speed = y[n + i]
        sin_b, cos_b = sin(y[i] + j.offset), cos(y[i] + j.offset)
        length = sqrt(j.pins - 2.0 * j.product * cos_b)
        lever = j.product * sin_b / length
        s, v = length - j.mid_length, lever * speed
        p_cap, p_rod = pressure(y[2 * n + i], bench), pressure(y[3 * n + i], bench)

        q_cap = j.leak_internal * (p_rod - p_cap) * (1.0 + LEAK_WIDENING * abs(p_rod - p_cap))
        q_rod = -q_cap - j.leak_rod * (p_rod - tank)
        q_cap -= j.leak_cap * (p_cap - tank)
        ahead = opening(spool[i], j.lap_ahead, j.rounding)
        if ahead > 0.0:
            flow = j.c_pp * ahead * orifice(port - p_cap, bench.laminar)
            back = j.c_mp * ahead * orifice(p_rod - tank, bench.laminar)
            q_cap, q_rod, demand, returned = q_cap + flow, q_rod - back, demand + flow, returned + back
        astern = opening(-spool[i], j.lap_astern, j.rounding)
        if astern > 0.0:
            flow = j.c_mm * astern * orifice(port - p_rod, bench.laminar)
            back = j.c_pm * astern * orifice(p_cap - tank, bench.laminar)
            q_rod, q_cap, demand, returned = q_rod + flow, q_cap - back, demand + flow, returned + back
        dy[2 * n + i] = (
            softening(y[2 * n + i], warmth, bench)
            * (q_cap - j.cap_area * v)
            / (j.cap_volume + s * j.cap_area)
        )
        dy[3 * n + i] = (
            softening(y[3 * n + i], warmth, bench)
            * (q_rod + j.rod_area * v)
            / (j.rod_volume - s * j.rod_area)
        )
        force = j.cap_area * p_cap - j.rod_area * p_rod - contact(s, v, j)
        dy[4 * n + i] = 0.0
        if j.bristle_stiffness > 0.0:
            friction, dy[4 * n + i] = bristle(y[4 * n + i], v, p_cap, p_rod, j)
            force -= friction
        twist = y[i] - j.spring_rest
        spring = j.spring * twist * (1.0 + j.spring_hardening * twist * twist)
        torque[i] = lever * force - j.viscous * speed - spring + j.torque_offset

        dy[i] = speed
        sin_q = sin_b * j.cos_offset - cos_b * j.sin_offset
        cos_q = cos_b * j.cos_offset + sin_b * j.sin_offset
        sine, cosine = sine * cos_q + cosine * sin_q, cosine * cos_q - sine * sin_q
        turn += speed
        theta[0, i], theta[1, i], rate[i] = sine, cosine, turn
    angular(theta, torque, rate, joints, inertia, m)
    for i in range(n):
        dy[n + i] = torque[i] - (torque[i - 1] if i > 0 else 0.0)

    line = demand
    dy[5 * n + 1] = 0.0
    if lined:
        line = bench.line_gain * orifice(p_supply - port, bench.laminar)
        stiff = softening(y[5 * n + 1], warmth, bench)
        dy[5 * n + 1] = stiff * (line - demand) / bench.manifold_volume
    stiff = softening(y[5 * n], warmth, bench)
    dy[5 * n] = stiff * (bench.pump - relief(p_supply, bench) - line) / bench.supply_volume
    back = bench.tank_pressure + bench.tank_resistance * returned * abs(returned)
    dy[5 * n + 2] = (back - tank) / bench.tank_lag


@jit
def spool_rates(u: float, w: float, x: float, target: float, joint: Any) -> Any:
    """Return the rates of LVDT voltage, its unlimited rate and the effective opening.

    u'' = omega^2 (target - u) - 2 zeta omega u', |u'| bounded; the opening may lag the LVDT.
    """
    slew = min(max(w, -joint.spool_rate), joint.spool_rate)
    push = joint.omega * joint.omega * (target - u) - 2.0 * joint.zeta * joint.omega * w
    return slew, push, (u - joint.null - x) * joint.opening_rate


@jit
def move_spool(start: Any, target: Any, h: float, joints: Any, end: Any) -> None:
    """Advance every spool by h [s] (RK4 on its own three states), `start` to `end`, (3, N)."""
    for i in range(len(joints)):
        j = joints[i]
        u, w, x, r = start[0, i], start[1, i], start[2, i], target[i]
        if u == r and w == 0.0 and x == u - j.null:
            end[0, i], end[1, i], end[2, i] = u, w, x
            continue
        g = 0.5 * h
        a, b, c = spool_rates(u, w, x, r, j)
        d, e, f = spool_rates(u + g * a, w + g * b, x + g * c, r, j)
        k, l, o = spool_rates(u + g * d, w + g * e, x + g * f, r, j)
        p, q, s = spool_rates(u + h * k, w + h * l, x + h * o, r, j)
        u += h / 6.0 * (a + 2.0 * (d + k) + p)
        w += h / 6.0 * (b + 2.0 * (e + l) + q)
        x += h / 6.0 * (c + 2.0 * (f + o) + s)
        if abs(u - r) < 1e-12 and abs(w) < 1e-9:
            u, w = r, 0.0  # arrived; without this the tail runs into denormal numbers
        if abs(u) > j.spool_stroke:
            u, w = copysign(j.spool_stroke, u), 0.0
        if j.opening_rate <= 0.0 or abs(x - u + j.null) < 1e-13:
            x = u - j.null
        end[0, i], end[1, i], end[2, i] = u, w, x


@jit
def crossing(start: Any, end: Any, h: float, joints: Any) -> float:
    """Return the fraction of the step at which the first spool passes its edges' null, else 1.

    There the flow's slope changes; a step that ends on it keeps its order. Cubic through both
    ends' values and rates, by Newton from the secant.
    """
    first = 1.0
    for i in range(len(joints)):
        a, b = start[2, i], end[2, i]
        if a * b >= 0.0 or joints[i].opening_rate > 0.0:
            continue
        da, db = start[1, i] * h, end[1, i] * h
        c2, c3 = 3.0 * (b - a) - 2.0 * da - db, da + db - 2.0 * (b - a)
        at = a / (a - b)
        for _ in range(3):
            slope = da + at * (2.0 * c2 + at * 3.0 * c3)
            if slope != 0.0:
                at -= (a + at * (da + at * (c2 + at * c3))) / slope
        if 1e-6 < at < first:
            first = at
    return first if first < 1.0 - 1e-6 else 1.0


@jit
def step(
    y: Any, spool: Any, target: Any, h: float, warmth: float, joints: Any, bench: Any,
    inertia: Any, w: Any, k: Any, ends: Any,
) -> None:
    """Advance state and spools in place by h [s]: classical RK4, split where a spool passes null.

    The spools move on their own and are known ahead at half and full step. Work: k (6, states),
    ends (2, 3, N).
    """
    size = len(y)
    half, end, trial = ends[0], ends[1], k[4]
    left = h
    while left > 0.0:
        d = left
        move_spool(spool, target, 0.5 * d, joints, half)
        move_spool(half, target, 0.5 * d, joints, end)
        at = crossing(spool, end, d, joints)
        if at < 1.0:
            d *= at
            move_spool(spool, target, 0.5 * d, joints, half)
            move_spool(half, target, 0.5 * d, joints, end)
        rates(y, spool[2], warmth, joints, bench, inertia, w, k[0])
        for n in range(size):
            trial[n] = y[n] + 0.5 * d * k[0, n]
        rates(trial, half[2], warmth, joints, bench, inertia, w, k[1])
        for n in range(size):
            trial[n] = y[n] + 0.5 * d * k[1, n]
        rates(trial, half[2], warmth, joints, bench, inertia, w, k[2])
        for n in range(size):
            trial[n] = y[n] + d * k[2, n]
        rates(trial, end[2], warmth, joints, bench, inertia, w, k[3])
        for n in range(size):
            y[n] += d / 6.0 * (k[0, n] + 2.0 * (k[1, n] + k[2, n]) + k[3, n])
        spool[:] = end
        left = left - d if at < 1.0 else 0.0


@jit
def sense(
    y: Any, dy: Any, spool: Any, heat: float, joints: Any, bench: Any, channels: Any,
    period: float, value: Any, rate: Any,
) -> None:
    """Write the true value and change per tick of every channel, (channels,) each, SI."""
    n = len(joints)
    for c in range(len(channels)):
        kind, i = channels[c].kind, channels[c].joint
        if kind == _SPOOL:
            value[c], rate[c] = spool[0, i], spool[1, i]
        elif kind == _PISTON:
            j = joints[i]
            beta = y[i] + j.offset
            length = sqrt(j.pins - 2.0 * j.product * cos(beta))
            value[c], rate[c] = length - j.mid_length, j.product * sin(beta) / length * y[n + i]
        elif kind in (_CAP, _ROD, _SUPPLY):
            at = 5 * n if kind == _SUPPLY else (2 * n if kind == _CAP else 3 * n) + i
            value[c] = pressure(y[at], bench)
            stiff = (value[c] + ATMOSPHERE) / sqrt(y[at] * y[at] + bench.trapped)
            rate[c] = stiff * dy[at]
        else:
            value[c], rate[c] = heat, 0.0
        rate[c] *= period


@jit
def delayed(tick: int, c: int, lag: float, values: Any, slopes: Any) -> float:
    """Return channel c at `lag` ticks before `tick`, from a ring of values and rates per tick.

    Ahead of the tick (negative lag: the multiplexer's skew) along the tangent, behind it by cubic
    Hermite interpolation.
    """
    ring = len(values)
    now = tick % ring
    if lag <= 0.0:
        return values[now, c] - lag * slopes[now, c]
    whole = int(lag) + 1
    t = whole - lag
    a, b = (tick - whole) % ring, (tick - whole + 1) % ring
    v, u = values[a, c], values[b, c]
    d, e = slopes[a, c], slopes[b, c]
    return v + t * (d + t * (3.0 * (u - v) - 2.0 * d - e + t * (d + e - 2.0 * (u - v))))


@jit
def temperature(time: float, bench: Any) -> float:
    """Return the oil's temperature [degC]: two slow waves that stay within the band."""
    a = sin(2.0 * np.pi * (time / bench.period_1 + bench.phase_1))
    b = sin(2.0 * np.pi * (time / bench.period_2 + bench.phase_2))
    return bench.temperature + bench.band * (0.7 * a + 0.3 * b)


@jit
def output(law: Any, waves: Any, tick: int, s: float, joint: Any) -> int:
    """Return the DA code of the output law at a tick, s being the piston as measured [m]."""
    v = law.bias + law.position_gain * (law.setpoint - s)
    if law.period > 0:
        v += law.gain * waves[law.first + (tick - law.start) % law.period]
    v = min(max(v, -law.limit), law.limit)
    code = np.rint(v * (joint.output_top / joint.output_range))
    return int(min(max(code, -joint.output_top), joint.output_top))


@jit
def run(
    tick: int, period: float, substeps: int, y: Any, spool: Any, values: Any, slopes: Any,
    joints: Any, bench_table: Any, inertia: Any, channels: Any, laws: Any, waves: Any, noise: Any,
    measured: Any, codes: Any,
) -> None:
    """Run len(measured) ticks: measure, evaluate the laws, hold the outputs for one period.

    In place: state y, spool, rings values and slopes (ring, channels). Out: measured SI values
    before coding (ticks, channels), DA codes (ticks, joints). `noise` is standard normal.
    """
    n, bench = len(joints), bench_table[0]
    w, k, ends = np.zeros((n + 4, n)), np.zeros((5, len(y))), np.zeros((2, 3, n))
    target, position = np.zeros(n), np.zeros(n)
    for row in range(len(measured)):
        heat = temperature(tick * period, bench)
        warmth = 1.0 + bench.bulk_temperature * (heat - bench.temperature)
        ring = tick % len(values)
        rates(y, spool[2], warmth, joints, bench, inertia, w, k[0])
        sense(y, k[0], spool, heat, joints, bench, channels, period, values[ring], slopes[ring])
        for c in range(len(channels)):
            h = channels[c]
            true = delayed(tick, c, h.lag / period, values, slopes)
            read = h.gain * true + h.offset + h.noise * noise[row, c]
            measured[row, c] = read
            if h.kind == _PISTON:
                code = min(max(np.rint((read - h.low) / h.step), 0.0), h.top)
                position[h.joint] = h.low + code * h.step
        for i in range(n):
            codes[row, i] = output(laws[i], waves, tick, position[i], joints[i])
            target[i] = codes[row, i] * (joints[i].output_range / joints[i].output_top)
            target[i] = min(max(target[i] * joints[i].spool_gain, -joints[i].spool_stroke),
                            joints[i].spool_stroke)
        for _ in range(substeps):
            step(y, spool, target, period / substeps, warmth, joints, bench, inertia, w, k, ends)
        tick += 1
