"""Equations of motion and of the oil of a two-joint hydraulic arm, with what may be wrong.

Sources: H. E. Merritt, *Hydraulic Control Systems*, 1967 (orifices, edges, chambers, leakage, line
drop); M. Jelali, A. Kroll, *Hydraulic Servo-systems*, 2003 (bulk modulus with air, spool dynamics,
friction of seals); C. Canudas de Wit et al., IEEE TAC 40, 1995 (LuGre); P. Dahl, 1968; D. Karnopp,
1985; R. Bouc, 1967; Y. K. Wen, 1976 (hysteresis). Neither `hil_sim` nor `analysis` was read for it.

The command is held between samples; the spool follows it as a first-order or a second-order lag,
or is the continuous waveform itself. A Runge-Kutta of fixed step integrates; the step divides the
sample's interval, so that no jump of the command falls inside.
"""

# mypy: disable-error-code="untyped-decorator"
# numba has no types of its own.

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Numbers of the bench, in the order of `MACHINE`.
MACHINE: Final = (
    "M1", "M2", "R12", "W1", "W2", "Fv1", "Fv2", "gravity", "bulk", "supply", "inclination",
    "tank", "return_drop", "return_lag", "sag", "sag_form", "sag_lag", "air", "polytropic",
    "air_form",
)  # fmt: skip
(
    M1, M2, R12, W1, W2, FV1, FV2, GRAVITY, BULK, SUPPLY, INCLINATION,
    TANK, RETURN_DROP, RETURN_LAG, SAG, SAG_FORM, SAG_LAG, AIR, POLYTROPIC,
    AIR_FORM,
) = range(len(MACHINE))  # fmt: skip
# Numbers of one joint, in the order of `JOINT`.
JOINT: Final = (
    "a", "c", "mid", "beta", "cap_area", "rod_area", "cap_volume", "rod_volume", "half",
    "C_pp", "C_pm", "C_mp", "C_mm",
    "ahead", "astern", "breakaway", "stribeck", "by_pressure", "pressure_form", "dry_form",
    "width", "taper", "slope_ahead", "slope_astern", "square",
    "stiffness", "rest", "cubic", "torque", "hum", "hum_hertz",
    "edge_ahead", "edge_astern", "edge_form", "edge_rounding", "underlap", "null", "play",
    "play_form", "play_travel", "spool_lag", "internal", "internal_form", "cap_leak", "rod_leak",
    "external_form", "worn", "spool_form", "spool_time", "spool_hertz", "spool_damping",
)  # fmt: skip
(
    A, C, MID, BETA, CAP_AREA, ROD_AREA, CAP_VOLUME, ROD_VOLUME, HALF,
    C_PP, C_PM, C_MP, C_MM,
    AHEAD, ASTERN, BREAKAWAY, STRIBECK, BY_PRESSURE, PRESSURE_FORM, DRY_FORM,
    WIDTH, TAPER, SLOPE_AHEAD, SLOPE_ASTERN, SQUARE,
    STIFFNESS, REST, CUBIC, TORQUE, HUM, HUM_HERTZ,
    EDGE_AHEAD, EDGE_ASTERN, EDGE_FORM, EDGE_ROUNDING, UNDERLAP, NULL, PLAY,
    PLAY_FORM, PLAY_TRAVEL, SPOOL_LAG, INTERNAL, INTERNAL_FORM, CAP_LEAK, ROD_LEAK,
    EXTERNAL_FORM, WORN, SPOOL_FORM, SPOOL_TIME, SPOOL_HERTZ, SPOOL_DAMPING,
) = range(len(JOINT))  # fmt: skip
TANH, DAHL, LUGRE, KARNOPP = range(4)
SHARP, ROUNDED, NOTCH = range(3)
BOTH_SEALS, DIFFERENCE, CAP_SEAL, ROD_SEAL, UNLIKE_SEALS = range(5)
BACKLASH, LINKAGE, MAGNET = range(3)
LAMINAR, TURBULENT = range(2)
QUADRATIC, LINEAR, LAGGED, ACCUMULATOR, REGULATOR = range(5)
CONTINUOUS, FIRST_ORDER, SECOND_ORDER = range(3)
# State: angles, speeds, four pressures, bristles, spools and their speeds, openings behind the
# spools, supply at the valve, tank line at the valve.
Q, W, P, BRISTLE, SPOOL, SPOOL_SPEED, OPENING, AT_VALVE, RETURN, SIZE = (
    0, 2, 4, 8, 10, 12, 14, 16, 17, 18,
)  # fmt: skip
STEP: Final = 4e-5  # [s]
PUMP: Final = 11.7e-3 / 60  # [m^3/s] at which drops of lines are stated
ATMOSPHERE: Final = 101_325.0
FAST_LINE: Final = 3e-4  # [s] lag of a line that has none worth speaking of


@njit(cache=True)
def root(x: float) -> float:
    """Square root with the sign of x: an orifice passes oil either way."""
    return math.sqrt(x) if x >= 0.0 else -math.sqrt(-x)


@njit(cache=True)
def stroke(q: float, j: Array) -> Any:
    """Piston displacement [m] and ds/dq [m], law of cosines."""
    square = j[A] ** 2 + j[C] ** 2 - 2.0 * j[A] * j[C] * math.cos(q + j[BETA])
    length = math.sqrt(square)
    return length - j[MID], j[A] * j[C] * math.sin(q + j[BETA]) / length


@njit(cache=True)
def opened(x: float, form: float, rounding: float) -> float:
    """Opening of an edge [V] at the spool's travel x past it; far out it is x."""
    if form == ROUNDED:
        return 0.5 * (x + math.sqrt(x * x + rounding * rounding))
    if form == NOTCH:  # a notch opens with the square, then the land's whole width is open
        if x <= -0.5 * rounding:
            return 0.0
        if x < 0.5 * rounding:
            return (x + 0.5 * rounding) ** 2 / (2.0 * rounding)
        return x
    return x if x > 0.0 else 0.0


@njit(cache=True)
def breakaway(v: float, j: Array) -> Any:
    """Friction [N] above the sliding level at speed v (Hess and Soom 1990)."""
    return j[BREAKAWAY] / (1.0 + (v / j[STRIBECK]) ** 2)


@njit(cache=True)
def pressing(cap: float, rod: float, form: float) -> float:
    """Pressure [Pa] that presses the seals: of both chambers, of one, or their difference."""
    if form == DIFFERENCE:
        return abs(cap - rod)
    if form == CAP_SEAL:
        return cap
    if form == ROD_SEAL:
        return rod
    return cap + (0.4 * rod if form == UNLIKE_SEALS else rod)


@njit(cache=True)
def level(v: float, s: float, cap: float, rod: float, j: Array) -> Any:
    """Sliding friction [N] at speed v: by direction, falling with speed, by pressure, by place."""
    size = j[AHEAD] if v >= 0.0 else j[ASTERN]
    size += breakaway(v, j)
    size += j[BY_PRESSURE] * pressing(cap, rod, j[PRESSURE_FORM])
    return size * (1.0 + j[TAPER] * s)


@njit(cache=True)
def dry(v: float, s: float, z: float, cap: float, rod: float, others: float, j: Array) -> Any:
    """Dry friction [N] and the bristle's rate [m/s]."""
    size = level(v, s, cap, rod, j)
    form = j[DRY_FORM]
    if size <= 0.0:
        return 0.0, 0.0
    if form == KARNOPP:
        if abs(v) < j[WIDTH]:
            hold = size + j[BREAKAWAY] - breakaway(v, j)
            return min(max(others, -hold), hold), 0.0
        return (size if v > 0.0 else -size), 0.0
    if form == TANH:
        return size * math.tanh(v / j[WIDTH]), 0.0
    # The bristles' deflection at sliding is WIDTH [m] at a level of one's own size.
    stiff = size / j[WIDTH]
    rate = v - abs(v) * z / j[WIDTH]
    if form == DAHL:
        return stiff * z, rate
    damping = 0.4 * math.sqrt(stiff * 100.0) * math.exp(-((v / 0.005) ** 2))
    return stiff * z + damping * rate, rate


@njit(cache=True)
def modulus(p: float, m: Array) -> Any:
    """Bulk modulus [Pa] of oil with free air at gauge pressure p."""
    if m[AIR] <= 0.0:
        return m[BULK]
    absolute = max(p, -0.9 * ATMOSPHERE) + ATMOSPHERE
    if m[AIR_FORM] == 0.0:  # Jelali & Kroll: air of polytropic change beside the oil
        ratio = (ATMOSPHERE / absolute) ** (1.0 / m[POLYTROPIC])
        soft = m[AIR] * ratio / (m[POLYTROPIC] * absolute)
        return (1.0 + m[AIR] * ratio) / (1.0 / m[BULK] + soft)
    # Part of the air dissolves: Henry's law takes it all away by some 6 MPa.
    free = m[AIR] * max(0.0, 1.0 - p / 6e6)
    return 1.0 / (1.0 / m[BULK] + free * ATMOSPHERE / absolute**2)


@njit(cache=True)
def flows(
    cap: float, rod: float, s: float, x: float, at_valve: float, tank: float, j: Array
) -> Any:
    """Flows into cap and rod chamber, drawn from the supply and given to the tank [m^3/s]."""
    x -= j[NULL]
    form, soft = j[EDGE_FORM], j[EDGE_ROUNDING]
    pa = opened(x - j[EDGE_AHEAD] + j[UNDERLAP], form, soft)
    at = opened(-x - j[EDGE_ASTERN] + j[UNDERLAP], form, soft)
    to_cap = j[C_PP] * pa * root(at_valve - cap)
    cap_out = j[C_PM] * at * root(cap - tank)
    rod_out = j[C_MP] * pa * root(rod - tank)
    to_rod = j[C_MM] * at * root(at_valve - rod)
    drop = cap - rod
    worn = 1.0 + j[WORN] * math.exp(-((s / 0.008) ** 2))
    past = j[INTERNAL] * worn * (drop if j[INTERNAL_FORM] == LAMINAR else root(drop) * 1e3)
    lost_cap = j[CAP_LEAK] * (cap if j[EXTERNAL_FORM] == LAMINAR else root(cap) * 1e3)
    lost_rod = j[ROD_LEAK] * (rod if j[EXTERNAL_FORM] == LAMINAR else root(rod) * 1e3)
    return (
        to_cap - cap_out - past - lost_cap, to_rod - rod_out + past - lost_rod,
        to_cap + to_rod, cap_out + rod_out,
    )  # fmt: skip


@njit(cache=True)
def rates(  # noqa: PLR0912  one branch an effect's form
    y: Array, t: float, m: Array, joints: Array, locked: Any, command: Any, out: Array
) -> None:
    """Derivatives of the state; `command` [V] is each joint's at this instant."""
    out[:] = 0.0
    q1, q2, w1, w2 = y[0], y[1], y[2], y[3]
    c2, n2 = math.cos(q2), math.sin(q2)
    m12 = m[M2] + m[R12] * c2
    m11, m22 = m[M1] + 2.0 * m[R12] * c2, m[M2]
    g, tilt = m[GRAVITY], m[INCLINATION]
    far = m[W2] * g * math.sin(q1 + q2 + tilt)
    load0 = m[W1] * g * math.sin(q1 + tilt) + far - m[R12] * n2 * (2.0 * w1 * w2 + w2 * w2)
    load1 = far + m[R12] * n2 * w1 * w1
    tau0 = tau1 = 0.0
    drawn = given = 0.0
    tank, at_valve = m[TANK] + y[RETURN], m[SUPPLY] - y[AT_VALVE]
    for i in range(2):
        j = joints[i]
        if locked[i]:
            continue
        q, w = y[Q + i], y[W + i]
        s, lever = stroke(q, j)
        v = lever * w
        cap, rod = y[P + 2 * i], y[P + 2 * i + 1]
        if j[SPOOL_FORM] == CONTINUOUS:
            spool = command[i]
        else:
            spool = y[SPOOL + i]
            if j[SPOOL_FORM] == FIRST_ORDER:
                out[SPOOL + i] = (command[i] - spool) / j[SPOOL_TIME]
            else:
                wn = 2.0 * math.pi * j[SPOOL_HERTZ]
                out[SPOOL + i] = y[SPOOL_SPEED + i]
                out[SPOOL_SPEED + i] = wn * (
                    wn * (command[i] - spool) - 2.0 * j[SPOOL_DAMPING] * y[SPOOL_SPEED + i]
                )
        x = spool
        if j[SPOOL_LAG] > 0.0:
            x = y[OPENING + i]
            out[OPENING + i] = (spool - x) / j[SPOOL_LAG]
        elif j[PLAY] > 0.0:
            x = y[OPENING + i]  # moved along in `integrated`: a play has no rate
        into_cap, into_rod, taken, left = flows(cap, rod, s, x, at_valve, tank, j)
        drawn += taken
        given += left
        half = j[HALF]
        # Karnopp: within the band of standstill nothing moves.
        sticks = j[DRY_FORM] == KARNOPP and j[AHEAD] > 0.0 and abs(v) < j[WIDTH]
        swept = 0.0 if sticks else v
        out[P + 2 * i] = (
            modulus(cap, m)
            * (into_cap - j[CAP_AREA] * swept)
            / (j[CAP_VOLUME] + (half + s) * j[CAP_AREA])
        )
        out[P + 2 * i + 1] = (
            modulus(rod, m)
            * (into_rod + j[ROD_AREA] * swept)
            / (j[ROD_VOLUME] + (half - s) * j[ROD_AREA])
        )
        load = load0 if i == 0 else load1
        away = q - j[REST]
        load += j[TORQUE] + j[STIFFNESS] * away * (1.0 + j[CUBIC] * away * away)
        load += j[HUM] * math.sin(2.0 * math.pi * j[HUM_HERTZ] * t)
        load += (m[FV1] if i == 0 else m[FV2]) * w
        load += lever * v * (j[SLOPE_AHEAD] if v > 0.0 else j[SLOPE_ASTERN])
        load += lever * j[SQUARE] * v * abs(v)
        torque = lever * (j[CAP_AREA] * cap - j[ROD_AREA] * rod) - load
        force, rate = dry(v, s, y[BRISTLE + i], cap, rod, torque / lever, j)
        out[BRISTLE + i] = rate
        if i == 0:
            tau0 = torque - lever * force
        else:
            tau1 = torque - lever * force
        out[Q + i] = 0.0 if sticks else w
    if locked[0] and not locked[1]:
        out[W + 1] = tau1 / m22
    elif locked[1] and not locked[0]:
        out[W] = tau0 / m11
    elif not locked[0]:
        det = m11 * m22 - m12 * m12
        out[W] = (m22 * tau0 - m12 * tau1) / det
        out[W + 1] = (m11 * tau1 - m12 * tau0) / det
    if m[SAG] > 0.0:
        share = drawn / PUMP
        if m[SAG_FORM] == QUADRATIC:
            out[AT_VALVE] = (m[SAG] * share * abs(share) - y[AT_VALVE]) / FAST_LINE
        elif m[SAG_FORM] == LINEAR:
            out[AT_VALVE] = (m[SAG] * share - y[AT_VALVE]) / FAST_LINE
        elif m[SAG_FORM] == LAGGED:
            out[AT_VALVE] = (m[SAG] * share - y[AT_VALVE]) / m[SAG_LAG]
        elif m[SAG_FORM] == REGULATOR:  # a pump that answers late to the drop of an orifice
            out[AT_VALVE] = (m[SAG] * share * abs(share) - y[AT_VALVE]) / m[SAG_LAG]
        else:  # a gas cushion: stiffer the fuller it is
            full = (m[SUPPLY] - y[AT_VALVE]) / m[SUPPLY]
            out[AT_VALVE] = full * (m[SAG] * share - y[AT_VALVE]) / m[SAG_LAG]
    if m[RETURN_DROP] > 0.0:
        share = given / PUMP
        lag = max(m[RETURN_LAG], FAST_LINE)
        out[RETURN] = (m[RETURN_DROP] * share * abs(share) - y[RETURN]) / lag


@njit(cache=True)
def asked(t: float, s: float, i: int, waves: Any, bias: Any, centring: Any) -> Any:
    """Command [V] of joint i: cosines, a bias, and slow centring on the piston."""
    u = bias[i] - centring * s
    for k in range(waves.shape[0]):
        if waves[k, 0] == i:
            u += waves[k, 1] * math.cos(waves[k, 2] * t + waves[k, 3])
    return u


@njit(cache=True)
def follows(u: float, x: float, before: float, j: Array) -> float:
    """Travel [V] of the edge at x behind a spool that moves from `before` to u [V].

    Backlash: the edge is pushed by half of the play. A linkage of some elasticity whose friction
    builds up along a travel (Dahl): it holds the edge back by at most half of the play. A magnet
    (Bouc 1967; Wen 1976, exponent 2, half of the loss on the way back).
    """
    half, moved = 0.5 * j[PLAY], u - before
    if j[PLAY_FORM] == BACKLASH:
        return float(min(max(x, u - half), u + half) - x)
    way = 1.0 if moved >= 0.0 else -1.0
    held = (before - x) / half
    if j[PLAY_FORM] == LINKAGE:
        return float(moved / (1.0 + half * (1.0 - way * held) / j[PLAY_TRAVEL]))
    return float(moved * held * held * (0.5 + 0.5 * (way if held >= 0.0 else -way)))


@njit(cache=True)
def integrated(
    start: Array, steps: int, held: Any, m: Array, joints: Array, locked: Any, waves: Any,
    bias: Any, centring: Any, first: int,
) -> Any:  # fmt: skip
    """Return states from step `first` on, (steps - first, SIZE), and the spools, (…, 2).

    The command is renewed every `held` steps (0: continuous).
    """
    y = start.copy()
    out = np.zeros((steps - first, SIZE))
    spools = np.zeros((steps - first, 2))
    a, b, c, d = np.zeros(SIZE), np.zeros(SIZE), np.zeros(SIZE), np.zeros(SIZE)
    u0, u1, u2 = np.zeros(2), np.zeros(2), np.zeros(2)
    before = y[OPENING : OPENING + 2].copy()
    for k in range(steps):
        t = k * STEP
        for i in range(2):
            if locked[i]:
                continue
            continuous = joints[i, SPOOL_FORM] == CONTINUOUS
            if continuous or k % held == 0:
                s = stroke(y[Q + i], joints[i])[0]
                u0[i] = asked(t, s, i, waves, bias, centring)
            u1[i] = asked(t + 0.5 * STEP, s, i, waves, bias, centring) if continuous else u0[i]
            u2[i] = asked(t + STEP, s, i, waves, bias, centring) if continuous else u0[i]
            spool = u0[i] if continuous else y[SPOOL + i]
            if joints[i, PLAY] > 0.0:
                y[OPENING + i] += follows(spool, y[OPENING + i], before[i], joints[i])
                before[i] = spool
            if k >= first:
                spools[k - first, i] = spool
        if k >= first:
            out[k - first] = y
        rates(y, t, m, joints, locked, u0, a)
        rates(y + 0.5 * STEP * a, t + 0.5 * STEP, m, joints, locked, u1, b)
        rates(y + 0.5 * STEP * b, t + 0.5 * STEP, m, joints, locked, u1, c)
        rates(y + STEP * c, t + STEP, m, joints, locked, u2, d)
        y += STEP / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        for i in range(4):
            y[P + i] = max(y[P + i], -0.95 * ATMOSPHERE)
    return out, spools
