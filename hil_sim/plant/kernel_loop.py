"""The plant's clock, compiled: spools, integration step, converters, output laws, ticks.

Spool state, shape (3, N): LVDT voltage, its rate, effective opening of the edges.
"""

from __future__ import annotations

from math import copysign, cos, exp, sin, sqrt
from typing import Any

import numpy as np

from hil_sim.plant.kernel import jit, pressure, rates, wave
from hil_sim.plant.kernel_data import ATMOSPHERE, KIND

_PISTON = KIND["piston"]
_CAP, _ROD = KIND["cap_pressure"], KIND["rod_pressure"]
_SPOOL, _SUPPLY = KIND["spool"], KIND["supply_pressure"]


@jit
def spool_rates(u: float, w: float, x: float, target: float, joint: Any) -> Any:
    """Return the rates of LVDT voltage, its unlimited rate and the effective opening.

    u'' = omega^2 (target - u) - 2 zeta omega u', |u'| bounded; the opening may lag the LVDT.
    """
    slew = min(max(w, -joint.spool_rate), joint.spool_rate)
    acceleration = joint.omega * joint.omega * (target - u) - 2.0 * joint.zeta * joint.omega * w
    return slew, acceleration, (u - joint.null - x) * joint.opening_rate


@jit
def with_play(x: float, u_before: float, x_before: float, u: float, joint: Any) -> float:
    """Return the opening [V] behind a spool's play, x being the opening without play.

    It deviates by at most half the play, reached at once or along `play_travel`.
    """
    half = 0.5 * joint.play
    if joint.play_travel <= 0.0:
        return float(min(max(x_before, x - half), x + half))
    side = copysign(half, u - u_before)
    off = u_before - joint.null - x_before
    return float(x - side - (off - side) * exp(-abs(u - u_before) / joint.play_travel))


@jit
def move_spool(start: Any, target: Any, h: float, joints: Any, end: Any) -> None:
    """Advance every spool by h [s] (RK4 on its own three states), `start` to `end`, (3, N)."""
    for i in range(len(joints)):
        j = joints[i]
        u, w, x, r = start[0, i], start[1, i], start[2, i], target[i]
        if u == r and w == 0.0 and (x == u - j.null or j.play > 0.0):
            end[0, i], end[1, i], end[2, i] = u, w, x
            continue
        g = 0.5 * h
        a, b, c = spool_rates(u, w, x, r, j)
        d, e, f = spool_rates(u + g * a, w + g * b, x + g * c, r, j)
        k, m, o = spool_rates(u + g * d, w + g * e, x + g * f, r, j)
        p, q, s = spool_rates(u + h * k, w + h * m, x + h * o, r, j)
        u += h / 6.0 * (a + 2.0 * (d + k) + p)
        w += h / 6.0 * (b + 2.0 * (e + m) + q)
        x += h / 6.0 * (c + 2.0 * (f + o) + s)
        if abs(u - r) < 1e-12 and abs(w) < 1e-9:
            u, w = r, 0.0  # arrived; without this the tail runs into denormal numbers
        if abs(u) > j.spool_stroke:
            u, w = copysign(j.spool_stroke, u), 0.0
        if j.opening_rate <= 0.0 or abs(x - u + j.null) < 1e-13:
            x = u - j.null
        if j.play > 0.0:
            x = with_play(x, start[0, i], start[2, i], u, j)
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
        if a * b >= 0.0 or joints[i].opening_rate > 0.0 or joints[i].play > 0.0:
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
    y: Any,
    spool: Any,
    target: Any,
    h: float,
    bulk_ratio: float,
    joints: Any,
    bench: Any,
    inertia: Any,
    w: Any,
    k: Any,
    ends: Any,
    first_known: bool,
) -> None:
    """Advance state and spools in place by h [s]: classical RK4, split where a spool passes null.

    The spools move on their own and are known ahead at half and full step. `first_known`: k[0]
    already holds the rates at the step's begin. Work: k (5, states), ends (2, 3, N).
    """
    size = len(y)
    half, end, trial = ends[0], ends[1], k[4]
    remaining = h
    while remaining > 0.0:
        d = remaining
        move_spool(spool, target, 0.5 * d, joints, half)
        move_spool(half, target, 0.5 * d, joints, end)
        at = crossing(spool, end, d, joints)
        if at < 1.0:
            d *= at
            move_spool(spool, target, 0.5 * d, joints, half)
            move_spool(half, target, 0.5 * d, joints, end)
        if not first_known:
            rates(y, spool[2], bulk_ratio, joints, bench, inertia, w, k[0])
        first_known = False
        for n in range(size):
            trial[n] = y[n] + 0.5 * d * k[0, n]
        rates(trial, half[2], bulk_ratio, joints, bench, inertia, w, k[1])
        for n in range(size):
            trial[n] = y[n] + 0.5 * d * k[1, n]
        rates(trial, half[2], bulk_ratio, joints, bench, inertia, w, k[2])
        for n in range(size):
            trial[n] = y[n] + d * k[2, n]
        rates(trial, end[2], bulk_ratio, joints, bench, inertia, w, k[3])
        for n in range(size):
            y[n] += d / 6.0 * (k[0, n] + 2.0 * (k[1, n] + k[2, n]) + k[3, n])
        for i in range(len(joints)):
            spool[0, i], spool[1, i], spool[2, i] = end[0, i], end[1, i], end[2, i]
        remaining = remaining - d if at < 1.0 else 0.0


@jit
def sense(
    y: Any,
    dy: Any,
    spool: Any,
    T_oil: float,
    joints: Any,
    bench: Any,
    channels: Any,
    period: float,
    value: Any,
    rate: Any,
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
            value[c], rate[c] = T_oil, 0.0
        rate[c] *= period


@jit
def delayed(now: int, c: int, lag: float, values: Any, slopes: Any) -> float:
    """Return channel c at `lag` ticks before place `now` of a ring of values and rates per tick.

    Ahead of the tick (negative lag: the multiplexer's skew) along the tangent, behind it by cubic
    Hermite interpolation.
    """
    whole = int(max(lag, 0.0)) + 1
    t = whole - lag
    if lag <= 0.0:
        whole, t = 0, -lag
    a = now - whole if now >= whole else now - whole + len(values)
    b = a + 1 if a + 1 < len(values) else 0
    v, d = values[a, c], slopes[a, c]
    bend = 0.0
    if whole > 0:
        u, e = values[b, c], slopes[b, c]
        bend = t * t * (3.0 * (u - v) - 2.0 * d - e + t * (d + e - 2.0 * (u - v)))
    delayed_value: float = v + t * d + bend
    return delayed_value


@jit
def filtered(x: float, h: Any, period: float) -> float:
    """Return a sensor filter's output for input x, exact where x is linear between ticks."""
    if h.filter_time <= 0.0:
        return x
    tau = h.filter_time / h.filter_stages
    decay = exp(-period / tau)
    if h.filter_started == 0.0:
        h.filter_started = 1.0
        h.filter_before = h.filter_first = h.filter_second = x
    first = lag_output(x, h.filter_before, h.filter_first, tau / period, decay)
    second = lag_output(first, h.filter_first, h.filter_second, tau / period, decay)
    h.filter_before, h.filter_first, h.filter_second = x, first, second
    filtered_value: float = second if h.filter_stages > 1 else first
    return filtered_value


@jit
def lag_output(x: float, before: float, previous: float, tau: float, decay: float) -> float:
    """Return a first-order lag's output one tick later, its input going from `before` to x."""
    slope = tau * (x - before)
    return x - slope + (previous - before + slope) * decay


@jit
def crosstalk(x: float, h: Any, period: float) -> float:
    """Return the crosstalk from another channel's x: a share of it, or of its high-passed part."""
    if h.crosstalk_high_pass > 0.0:
        h.crosstalk_slow += (x - h.crosstalk_slow) * period  # a filter of one second
        x -= h.crosstalk_slow
    return float(h.crosstalk_share * x)


@jit
def temperature(time: float, bench: Any) -> float:
    """Return the oil's temperature [degC]: two slow waves that stay within the band."""
    a = sin(2.0 * np.pi * (time / bench.period_1 + bench.phase_1))
    b = sin(2.0 * np.pi * (time / bench.period_2 + bench.phase_2))
    T_oil: float = bench.temperature + bench.band * (0.7 * a + 0.3 * b)
    return T_oil


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
def hold_waves(tick: int, time: float, period: float, joints: Any, laws: Any) -> None:
    """Set each joint's periodic torque to its value `time` [s] after a tick.

    It is constant over an integration step, which is short compared with the wave's period.
    """
    for i in range(len(joints)):
        if joints[i].wave_torque > 0.0:
            since = (tick - laws[i].start) * period + time
            turned = wave(joints[i].wave_rate * since, joints[i].wave_form)
            joints[i].wave_now = joints[i].wave_torque * turned


def work_size(n: int) -> int:
    """Return the length of the array in which `run` keeps its intermediate values of N joints."""
    return 5 * (5 * n + 3) + 6 * n + (n + 4) * n + 2 * n


@jit
def run(
    tick: int,
    period: float,
    substeps: int,
    y: Any,
    spool: Any,
    values: Any,
    slopes: Any,
    joints: Any,
    bench_table: Any,
    inertia: Any,
    channels: Any,
    laws: Any,
    waves: Any,
    noise: Any,
    measured: Any,
    codes: Any,
    work: Any,
) -> None:
    """Run len(measured) ticks: measure, evaluate the laws, hold the outputs for one period.

    In place: state y, spool, rings values and slopes (ring, channels). Out: AD codes (ticks,
    channels) as `rig.model.wire.codes.encode_input` defines them, DA codes (ticks, joints). `noise`
    is standard normal, (ticks, channels); work has `work_size` elements.
    """
    n, bench = len(joints), bench_table[0]
    # One array for all: each further one costs time to hand over, for every block of ticks.
    a = 5 * len(y)
    b = a + 6 * n
    c = b + (n + 4) * n
    k, ends = work[:a].reshape(5, len(y)), work[a:b].reshape(2, 3, n)
    w = work[b:c].reshape(n + 4, n)
    target, position = work[c : c + n], work[c + n :]
    for row in range(len(measured)):
        T_oil = temperature(tick * period, bench)
        bulk_ratio = 1.0 + bench.bulk_temperature * (T_oil - bench.temperature)
        ring = tick % len(values)
        length = period / substeps
        hold_waves(tick, 0.5 * length, period, joints, laws)
        rates(y, spool[2], bulk_ratio, joints, bench, inertia, w, k[0])
        sense(y, k[0], spool, T_oil, joints, bench, channels, period, values[ring], slopes[ring])
        for c in range(len(channels)):
            h = channels[c]
            true = filtered(delayed(ring, c, h.lag / period, values, slopes), h, period)
            if h.crosstalk_source > 0:
                source = h.crosstalk_source - 1
                lag = channels[source].lag / period
                true += crosstalk(delayed(ring, source, lag, values, slopes), h, period)
            read = h.gain * true + h.offset + h.noise * noise[row, c]
            code = min(max(np.rint((read - h.low) * h.scale), 0.0), h.top)
            measured[row, c] = int(code)
            if h.kind == _PISTON:
                position[h.joint] = h.low + code * h.step
        for i in range(n):
            codes[row, i] = output(laws[i], waves, tick, position[i], joints[i])
            target[i] = codes[row, i] * (joints[i].output_range / joints[i].output_top)
            target[i] = min(
                max(target[i] * joints[i].spool_gain, -joints[i].spool_stroke),
                joints[i].spool_stroke,
            )
        for part in range(substeps):
            if part:
                hold_waves(tick, (part + 0.5) * length, period, joints, laws)
            step(y, spool, target, length, bulk_ratio, joints, bench, inertia, w, k, ends, not part)
        tick += 1
