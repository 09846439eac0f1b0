"""Scatter between repeats beyond sensor noise: notes on it, and periodic torques of any phase.

A pump, a neighbouring machine or an intermittent fault acts with another phase in every repeat: it
counts as noise and leaves no repeatable residual. A torque at one frequency is named: the scatter
between the repeats shows the frequency, and a sine of free amplitude and phase is fitted to every
record of that torque balance and subtracted. The amplitude must be the same in all records.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from analysis.effects.disturbance import FREQUENCY, PeriodicDisturbance
from analysis.effects.mechanics import torque_limit
from analysis.identify.settings import IDENTIFY
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import WAVES, Line, sines_at, without_sines
from analysis.simulation.model import Estimate
from analysis.terms.base import equation, joint_of
from analysis.trace.data.conditioned_record import model_rows, row_residual
from analysis.trace.data.noise_floor import PERIODS, REPEATS, Floor, Group, sine_energy
from analysis.trace.data.regression_data import RegressionData, Segment
from analysis.trace.data.set_aside import in_judging_block
from analysis.trace.judge.gates import INVARIANT, NO_RIVAL, PHYSICAL, REMOVES, SIGNIFICANT
from analysis.trace.result import Gate, JudgedEffect
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.settings import DATA, TRACE
from rig.model.rig import Rig
from rig.model.units import plain

Array = NDArray[np.float64]


def unlocked_lines(data: RegressionData) -> tuple[Line, ...]:
    """Return joint and frequency of torques whose phase differs between repeats.

    The scatter between the repeats of the joint's torque balance is `DATA.line_ratio` times what
    the stated noise makes, and more than `DATA.unrepeated_share` of its energy is at one frequency.
    Excluded are a drift, of fewer than `DATA.least_turns` periods; a frequency at which the
    joint's velocity has as large a share, since a load that varies with the motion scatters there;
    and one at which another balance scatters too, as a sensor error would cause.
    """
    repeated = {(f.group, f.equation): f for f in data.floors if f.source == REPEATS}
    scattered: dict[str, list[Segment]] = {}
    for s in data.segments:
        floor = repeated.get((s.group, s.equation))
        if floor is not None and floor.noise > DATA.line_ratio * floor.stated:
            scattered.setdefault(s.equation, []).append(s)
    frequencies: dict[str, float] = {}
    for e, segments in scattered.items():
        f, share = dominant_frequency([scatter(data, s) for s in segments])
        if share > DATA.unrepeated_share:
            frequencies[e] = f
    out = []
    for e, f in frequencies.items():
        joint = joint_of(e)
        others = [g for other, g in frequencies.items() if other != e]
        velocities = [_velocity(data, s, joint) for s in scattered[e]]
        length = max(float(time[-1] - time[0]) for time, _ in velocities)
        if (
            e == equation("torque", joint)
            and FREQUENCY[0] <= f <= FREQUENCY[1]
            and f * length >= DATA.least_turns
            and not any(abs(f - g) * length < 1.0 for g in others)
            and not _moves_at(velocities, f, length)
        ):
            out.append((joint, f))
    return tuple(out)


def _velocity(data: RegressionData, segment: Segment, joint: int) -> tuple[Array, Array]:
    """Return the instants (m,) of a segment, and the joint's velocity (1, m) at them."""
    conditioned, rows = data.source(segment)
    velocity = conditioned.signals.qd[conditioned.samples_at(rows.time), joint]
    return rows.time, velocity[None] - velocity.mean()


def _moves_at(velocities: Sequence[tuple[Array, Array]], frequency: float, length: float) -> bool:
    """Return whether most of the energy of velocities (1, m) lies at a frequency [Hz]."""
    dominant, share = dominant_frequency(velocities)
    return abs(dominant - frequency) * length < 1.0 and share > DATA.unrepeated_share


@dataclass(frozen=True)
class _LineFit:
    """A sine fitted to one record's torque balance: amplitude and its error, SI.

    `before` and `after` are the residual's energies over `count` rows; `seconds` is the record's
    length.
    """

    group: Group
    seconds: float
    amplitude: float
    error: float
    before: float
    after: float
    count: int


def _fitted_line(
    rig: Rig, conditioned: ConditionedRecord, fit: ExactFit, line: Line, chosen: bool
) -> _LineFit | None:
    """Fit a sine to a model's residual in one record; return None where the joint is locked.

    `chosen`: leave out the judging rows.
    """
    rows = model_rows(rig, fit.terms, conditioned).get(equation("torque", line[0]))
    if rows is None or len(rows.time) < TRACE.least_rows:
        return None
    with_line = replace(conditioned.filtering, lines=(line,))
    residual, sines = row_residual(rows, fit.beta), sines_at(rows, conditioned.signals, with_line)
    after = without_sines(residual, sines)
    waves = np.linalg.lstsq(sines, residual, rcond=None)[0]
    noise = float(np.sqrt(after @ after / max(len(after) - len(WAVES), 1)))
    sine_norm = math.sqrt(float(np.sum(sines**2)) / len(WAVES))
    used = ~in_judging_block(rows.time) if chosen else np.ones(len(after), dtype=bool)
    return _LineFit(
        conditioned.group, float(rows.time[-1] - rows.time[0]), float(np.hypot(*waves)),
        noise / sine_norm, float(residual[used] @ residual[used]), float(after[used] @ after[used]),
        int(used.sum()),
    )  # fmt: skip


def judged_line(
    rig: Rig,
    line: Line,
    fit: ExactFit,
    train: Sequence[ConditionedRecord],
    holdout: Sequence[ConditionedRecord],
    divided: Collection[Group],
    noise: float,
) -> JudgedEffect:
    """Return a periodic torque, fitted to the residual of a model, with its gates.

    `train` and `holdout` are the single records, not averaged over repeats; of those in `divided`
    the rows that judge are left out. `noise` is the noise floor of the joint's torque balance in
    the held-out records, SI.
    """
    joint, frequency = line
    fits = [_fitted_line(rig, c, fit, line, False) for c in train]
    train_fits = [f for f in fits if f is not None]
    fits = [_fitted_line(rig, c, fit, line, c.group in divided) for c in holdout]
    held_out_fits = [f for f in fits if f is not None]
    amplitude = _mean_amplitude(rig, joint, train_fits)
    before, after = sum(f.before for f in held_out_fits), sum(f.after for f in held_out_fits)
    quiet = noise**2 * sum(f.count for f in held_out_fits)
    removed = 1.0 - max(0.0, after - quiet) / (before - quiet) if before > quiet else 0.0
    tolerance = TRACE.invariance_tolerance * amplitude.value
    differing = [
        f"{plain(f.amplitude, 2)} in {f.group[1]}"
        for f in train_fits
        if abs(f.amplitude - amplitude.value) > max(tolerance, TRACE.standard_errors * f.error)
    ]
    p = _noise_probability(train_fits)
    limit, effect = torque_limit(rig, joint), PeriodicDisturbance(f"joint {joint + 1}")
    size = f"amplitude {plain(amplitude.value, 2)} of the {plain(limit, 2)} that may be"
    share = f"{100 * removed:.0f} % of the energy above noise"
    alike = "; ".join(differing[:3]) or "the same amplitude in all records"
    gates = (
        Gate(REMOVES, removed >= TRACE.least_removed, share),
        Gate(PHYSICAL, amplitude.value < limit, size),
        Gate(INVARIANT, not differing, alike),
        Gate(SIGNIFICANT, p <= TRACE.p_limit, f"p = {p:.3g} over all frequencies"),
        Gate(NO_RIVAL, True, "its phase does not follow the excitation, as effects of motion do"),
    )
    error = _frequency_error(train_fits, amplitude.value)
    scale = noise * math.sqrt(max(sum(f.count for f in held_out_fits), 1))
    parameters = {
        f"T_amplitude_{joint + 1}": amplitude,
        effect.shape_names()[0]: _estimate(frequency, "Hz", error),
    }
    return JudgedEffect(
        effect.name, effect.where, parameters, p, removed, (), gates, effect.variable,
        mechanism=effect.mechanism, at=effect.where,
        rms_without=math.sqrt(before) / scale, rms_with=math.sqrt(after) / scale,
    )  # fmt: skip


def _mean_amplitude(rig: Rig, joint: int, fits: Sequence[_LineFit]) -> Estimate:
    """Return the mean amplitude; its error includes the scatter between records beyond noise."""
    weight = np.array([1.0 / f.error**2 for f in fits])
    values = np.array([f.amplitude for f in fits])
    spread = float(values.std(ddof=1)) / math.sqrt(len(fits))
    unit = PeriodicDisturbance(f"joint {joint + 1}").coefficients(rig)[0].unit
    mean = float(weight @ values / weight.sum())
    return _estimate(mean, unit, max(spread, 1.0 / math.sqrt(float(weight.sum()))))


def _noise_probability(fits: Sequence[_LineFit]) -> float:
    """Return Fisher's probability that noise has as large a line at any frequency."""
    share = 1.0 - sum(f.after for f in fits) / max(sum(f.before for f in fits), 1e-300)
    count = sum(f.count for f in fits) / 2
    return float(min(1.0, count * (1.0 - share) ** (count - 1.0)))


def _frequency_error(fits: Sequence[_LineFit], amplitude: float) -> float:
    """Return the standard error of the frequency [Hz] of sines of free phase in several records.

    Of a record of T seconds it is sqrt(12) / (2 pi T) times the phase's error (Rife and Boorstyn,
    1974).
    """
    information = sum((2 * math.pi * f.seconds * amplitude / f.error) ** 2 / 12.0 for f in fits)
    return 1.0 / math.sqrt(information)


def _estimate(value: float, unit: str, std: float) -> Estimate:
    half = IDENTIFY.normal_quantile * std
    return Estimate(value, unit, std, (value - half, value + half))


def phase_notes(effects: Sequence[JudgedEffect], lines: Sequence[Line]) -> list[str]:
    """Return a note for each named torque whose phase differs between records."""
    of_joint = {f"joint {joint + 1}": (joint, f) for joint, f in lines}
    named_lines = [
        of_joint[e.where]
        for e in effects
        if e.name == PeriodicDisturbance.name and e.where in of_joint
    ]
    return [
        f"{equation('torque', joint)}: the torque at {plain(f, 3)} Hz has another phase in each "
        "record; it is fitted to each record separately, and models and free runs leave it out"
        for joint, f in named_lines
    ]


def unrepeated_notes(data: RegressionData) -> list[str]:
    """Return a note for each equation whose scatter between repeats exceeds stated sensor noise.

    The limit is `DATA.unrepeated_ratio`; of several groups the one with the largest ratio is noted.
    """
    return [_unrepeated_note(data, floor) for floor in unrepeated_floors(data).values()]


def unrepeated_floors(data: RegressionData) -> dict[str, Floor]:
    """Return the floor with the largest ratio to the stated noise, of each equation to be noted.

    Floors of steps whose rows are left out do not count.
    """
    used = {(s.group, s.equation) for s in data.segments}
    worst: dict[str, Floor] = {}
    for floor in data.floors:
        measured = floor.source in (REPEATS, PERIODS) and (floor.group, floor.equation) in used
        if measured and floor.noise > DATA.unrepeated_ratio * floor.stated:
            best = worst.get(floor.equation)
            if best is None or floor.noise / floor.stated > best.noise / best.stated:
                worst[floor.equation] = floor
    return worst


def _unrepeated_note(data: RegressionData, floor: Floor) -> str:
    segment = next(
        s for s in data.segments if (s.group, s.equation) == (floor.group, floor.equation)
    )
    at = ""
    if segment.repeats > 1:  # periods hold no other frequency
        frequency, share = dominant_frequency([scatter(data, segment)])
        if share > DATA.unrepeated_share:
            at = f", {plain(100 * share, 2)} % of it at {plain(frequency, 3)} Hz"
    return (
        f"{floor.equation}: what differs between repeats is {plain(floor.noise / floor.stated, 2)} "
        f"times what the stated sensor noise makes{at}: a sensor is noisier than stated, or "
        "something acts that does not follow the excitation, which the trace cannot see"
    )


def scatter(data: RegressionData, segment: Segment) -> tuple[Array, Array]:
    """Return the instants (m,) of a segment, and its repeats' residuals (n, m) less their mean."""
    rows = data.residual[: segment.repeats, segment.where]
    return data.source(segment)[1].time, rows - rows.mean(axis=0)


def dominant_frequency(parts: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Return the frequency [Hz] with most of the energy of series, and its share of the energy.

    `parts` are instants (m,) [s] with series (n, m) of any phase.
    """
    length = max(float(time[-1] - time[0]) for time, _ in parts)
    highest = 0.5 / float(np.median(np.diff(parts[0][0])))
    total = sum(float(np.sum(series**2)) for _, series in parts)

    def share(frequency: Array) -> Array:
        return np.asarray(sum(_sine_energy(t, series, frequency) for t, series in parts) / total)

    frequency = np.arange(2.0 / length, highest, DATA.line_step / length)
    coarse = float(frequency[np.argmax(share(frequency))])
    bounds = (coarse - DATA.line_step / length, coarse + DATA.line_step / length)
    best = minimize_scalar(lambda f: -share(np.array([f])).item(), bounds=bounds, method="bounded")
    return float(best.x), -float(best.fun)


def _sine_energy(time: Array, series: Array, frequency: Array) -> Array:
    """Return the energy (f,) that a sine at each frequency [Hz] fits in series (n, m), summed."""
    series = series - series.mean(axis=1, keepdims=True)
    angle = 2 * np.pi * time[:, None] * frequency
    return sine_energy(np.cos(angle), np.sin(angle), series)
