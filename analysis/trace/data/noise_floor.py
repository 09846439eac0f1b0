"""Noise floor: what of a residual repeats (model error) and what does not (noise).

With n repeats r_k(t) of one excitation,
 noise^2 = mean_t var_k r_k (ddof 1),   repeatable^2 = mean_t (mean_k r_k)^2 - noise^2 / n.
A record that is the only repeat of its step is cut into its periods, which serve as repeats. Where
there are no periods either, but the motion comes back to states x where it was before,
 noise^2 = mean 1/2 (r(x') - r(x))^2 over the nearest pairs of states
(a difference estimator: Rice 1984; Evans and Jones 2002). Where the motion does not come back, the
rig's stated sensor noise, propagated to the same rows, is used, times the ratio of measured to
stated noise in other steps: in repeats and periods, else between neighbours. Without these that
ratio is taken from the octave above the rows' band, where a model's residual is mostly noise:
effects of the motion fall with frequency, and the noise of a differentiated channel grows. Where
repeats of other steps scatter by up to `DATA.coloured_ratio` times that ratio, theirs is used:
sensor noise need not be white.

The floor is at least `DATA.least_noise` of the stated noise: with sensors much better than their
data sheet (or simulated without noise), repeats would resolve differences of no practical interest,
and a clean bench would never be `clean`. The rounding error of a coarse converter that is the
same in every repeat counts as noise too, up to its size by the rig file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.noise import (
    repeated_rounding,
    sensor_variance,
    with_added_noise,
    with_added_rounding,
)
from analysis.regression.rows import Rows, filtering_above_rows, in_common
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import model_rows, row_residual
from analysis.trace.settings import DATA
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig

Array = NDArray[np.float64]

REPEATS, PERIODS, NEIGHBOURS, STATED = "repeats", "periods", "neighbouring states", "stated noise"
OTHER_STEPS = "noise of other steps"
ABOVE = "frequencies above the rows'"
UNSTATED = "a residual that follows nothing"
Group = tuple[int, str]
LINES_AT_ONCE = 256  # frequencies tried at once: bounds the memory
# Determinant of two waves over that of orthogonal ones, times 4, below which they are one.
SAME_COLUMN = 1e-6
NO_ROWS = 1e-30  # SI: noise of an equation whose rows are all masked; it weights no row


@dataclass(frozen=True)
class Floor:
    """The split of one equation's residual in one group of records, SI.

    `noise`, `repeatable` and `total` are rms values of the residual. `source` says what the noise
    was computed from, `count` from how many repeats or periods. `stated` is the rms that the rig
    file's sensor noise alone makes.
    """

    group: Group
    equation: str
    noise: float
    repeatable: float
    total: float
    count: int
    source: str
    stated: float

    @property
    def ratio(self) -> float:
        """The repeatable part over the noise."""
        return self.repeatable / self.noise if self.noise > 0 else float("inf")

    def unrepeated(self, noise: float, source: str) -> Floor:
        """Return the floor with a noise without repeats: all above it counts as repeatable."""
        repeatable = float(np.sqrt(max(0.0, self.total**2 - noise**2)))
        return replace(self, noise=noise, repeatable=repeatable, count=1, source=source)


def floors(
    rig: Rig,
    terms: Sequence[Used],
    members: Sequence[ConditionedRecord],
    rows: Sequence[Mapping[str, Rows]],
    beta: Mapping[str, float],
    others: Sequence[Floor] = (),
    noise_ratio: Mapping[str, float] | None = None,
) -> list[Floor]:
    """Return the split of every equation of every group of records under a model.

    `others` are floors of other records of the machine: groups without repeats take the ratio of
    measured to stated noise from those and from the groups whose noise was measured. Where neither
    gives it, `noise_ratio` does, by equation; a noise by neighbouring states is at most that.
    """
    groups: dict[Group, list[int]] = {}
    for index, conditioned in enumerate(members):
        groups.setdefault(conditioned.group, []).append(index)
    sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
    # Whether a sensor's rounding error repeats, since its converter is coarser than its noise.
    coarse = any(repeated_rounding(s) >= DATA.least_rounding * sensor_variance(s) for s in sensors)
    out = []
    for indices in groups.values():
        first, group_rows = members[indices[0]], [rows[i] for i in indices]
        stated, rounding = stated_noise(rig, terms, first, group_rows[0], beta), dict[str, float]()
        if coarse:  # of the filter of the rows, or of the channels where rows have none
            smoother = first.filtering.rows or first.filtering.channels
            rounded = partial(with_added_rounding, smoother=smoother)
            draws = DATA.rounding_draws
            rounding = stated_noise(rig, terms, first, group_rows[0], beta, rounded, draws)
        of_group = []
        for equation, rms in stated.items():
            parts = [r[equation] for r in group_rows if equation in r]
            of_group.append(_floor(first, parts, beta, rms, rounding.get(equation, 0.0)))
        if any(floor.source == NEIGHBOURS for floor in of_group):
            disturbed = partial(with_added_noise, as_measured=True)
            least = stated_noise(rig, terms, first, group_rows[0], beta, disturbed)
            of_group = [_at_least(floor, least) for floor in of_group]
        out += of_group
    by_repeats = _measured_over_stated([*out, *others], (REPEATS,))
    scale = _measured_over_stated([*out, *others], (NEIGHBOURS,))
    scale |= _measured_over_stated([*out, *others], (REPEATS, PERIODS))
    scaled = (_scaled(_without_aperiodic(f, by_repeats), scale, OTHER_STEPS) for f in out)
    split = [_by_ratio(floor, noise_ratio or {}) for floor in scaled]
    if coarse:  # rounding errors of a slow signal have another spectrum than noise
        return split
    above = {
        group: noise_above_rows(rig, terms, members[groups[group][0]], beta)
        for group in {f.group for f in split if f.source == STATED and f.total > 0.0}
    }
    repeated = _measured_over_stated([*out, *others], (REPEATS,), np.inf)

    def without_repeats(floor: Floor) -> Floor:
        if floor.source != STATED:
            return floor
        ratios = above.get(floor.group, {})
        ratio, measured = (r.get(floor.equation, 1.0) for r in (ratios, repeated))
        if ratio < measured < DATA.coloured_ratio * ratio:
            return _scaled(floor, repeated, OTHER_STEPS)
        return _scaled(floor, _within_residual(floor, ratios), ABOVE)

    return [without_repeats(floor) for floor in split]


def noise_above_rows(
    rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord, beta: Mapping[str, float]
) -> dict[str, float]:
    """Return by equation the ratio of noise to the stated one in the octave above the rows'.

    Ratios below 1 are left out.
    """
    filtering = filtering_above_rows(conditioned.record, conditioned.filtering)
    above = replace(conditioned, filtering=filtering)
    rows = model_rows(rig, terms, above)
    rng = np.random.default_rng(0)
    ratios = {}
    for e, (at, noise) in _noise_rows(rig, terms, above, rows, beta, with_added_noise, rng).items():
        if len(noise) >= DATA.least_pairs and np.any(noise):
            residual = row_residual(rows[e], beta)[at]
            ratios[e] = _spectral_ratio(rows[e].time[at], residual, noise)
    return {e: ratio for e, ratio in ratios.items() if ratio > 1.0}


def _spectral_ratio(time: Array, residual: Array, noise: Array) -> float:
    """Return the rms ratio of the broad-band part of a residual (m,) to noise (m,) at times [s].

    The largest powers are left out, such as those of a hum above the rows' frequencies, which is no
    measure of the noise in the rows. Instants without rows count as zero.
    """
    step = float(np.min(np.diff(time)))
    at = np.rint((time - time[0]) / step).astype(np.int64)
    series = np.zeros((2, int(at[-1]) + 1))
    series[:, at] = residual, noise
    power, of_noise = np.abs(np.fft.rfft(series * np.hanning(series.shape[1]))) ** 2
    of_noise = uniform_filter1d(of_noise, DATA.smoothed_frequencies)
    passed = of_noise >= DATA.passed_power * np.max(of_noise)
    ratio = np.sort(power[passed] / of_noise[passed])
    kept = DATA.broad_share
    # Of noise, powers are distributed exponentially: their mean up to the share that is kept.
    mean = 1.0 + (1.0 - kept) * math.log1p(-kept) / kept
    return math.sqrt(float(np.mean(ratio[: math.ceil(kept * len(ratio))])) / mean)


def _within_residual(floor: Floor, ratios: Mapping[str, float]) -> dict[str, float]:
    """Return ratios of noise to the stated one, at most that of a floor's whole residual.

    The residual holds the noise: what more lies above the rows' frequencies is not in the rows.
    """
    most = max(1.0, floor.total / max(floor.stated, NO_ROWS))
    return {equation: min(ratio, most) for equation, ratio in ratios.items()}


def _floor(
    conditioned: ConditionedRecord, parts: Sequence[Rows], beta: Mapping[str, float],
    stated: float, rounding: float,
) -> Floor:  # fmt: skip
    """Return the split of one equation's residual in the repeats of a step, of rows `parts`.

    `stated` and `rounding` are the rms that the rig's sensor noise and their converters make.
    """
    residual = [row_residual(rows, beta) for rows in parts]
    squares = np.concatenate(residual) ** 2
    total = float(np.sqrt(np.mean(squares))) if len(squares) else 0.0  # all rows masked
    floor = Floor(conditioned.group, parts[0].equation, stated, 0.0, total, 1, STATED, stated)
    table, source = stacked_repeats(conditioned, parts, residual)
    if table is not None:
        noise2 = float(np.mean(np.var(table, axis=0, ddof=1)))
        mean2 = float(np.mean(np.mean(table, axis=0) ** 2))
        repeatable = float(np.sqrt(max(0.0, mean2 - noise2 / len(table))))
        rounded = min(repeatable, rounding)
        measured = max(float(np.hypot(np.sqrt(noise2), rounded)), DATA.least_noise * stated)
        rest = float(np.sqrt(repeatable**2 - rounded**2))
        return replace(floor, noise=measured, repeatable=rest, count=len(table), source=source)
    noise = noise_by_neighbours(conditioned, parts[0], residual[0]) if len(parts) == 1 else None
    if noise is None:
        return floor.unrepeated(stated, STATED)
    return floor.unrepeated(max(noise, DATA.least_noise * stated), NEIGHBOURS)


def _at_least(floor: Floor, least: Mapping[str, float]) -> Floor:
    """Return a floor by neighbouring states, at least the white noise of the record's sensors.

    States are taken for neighbours by their noise too, which is that of their rows: the difference
    of these is smaller than that of two independent ones.
    """
    if floor.source != NEIGHBOURS or floor.noise >= least[floor.equation]:
        return floor
    return floor.unrepeated(least[floor.equation], NEIGHBOURS)


def _without_aperiodic(floor: Floor, by_repeats: Mapping[str, float]) -> Floor:
    """Return a floor, by stated noise where periods scatter more than repeats of other steps do.

    That scatter is no sensor noise, but a cause with another period, such as a hum.
    """
    noisy = floor.noise > DATA.unrepeated_ratio * floor.stated
    if floor.source != PERIODS or not noisy or floor.equation not in by_repeats:
        return floor
    return floor.unrepeated(floor.stated, STATED)


def _measured_over_stated(
    split: Sequence[Floor], sources: Collection[str], most_ratio: float = DATA.unrepeated_ratio
) -> dict[str, float]:
    """Return by equation the rms ratio of noise measured from `sources` to stated noise.

    Each group counts by the degrees of freedom of its repeats. Ratios above `most_ratio` are left
    out: they may show a cause that does not follow the excitation, not sensor noise.
    """
    ratios: dict[str, list[float]] = {}
    weights: dict[str, list[int]] = {}
    for floor in split:
        most = most_ratio * floor.stated
        if floor.source in sources and floor.stated > NO_ROWS and floor.noise <= most:
            ratios.setdefault(floor.equation, []).append(floor.noise / floor.stated)
            weights.setdefault(floor.equation, []).append(max(1, floor.count - 1))
    return {
        e: float(np.sqrt(np.average(np.square(measured), weights=weights[e])))
        for e, measured in ratios.items()
    }


def _scaled(floor: Floor, scale: Mapping[str, float], source: str) -> Floor:
    """Return a floor by stated noise multiplied by the ratio of its equation; others unchanged."""
    if floor.source != STATED or floor.equation not in scale:
        return floor
    return floor.unrepeated(floor.stated * scale[floor.equation], source)


def _by_ratio(floor: Floor, noise_ratio: Mapping[str, float]) -> Floor:
    """Return a floor with the ratio to the stated noise where nothing else measures a smaller one.

    Between neighbouring states the residual of a model that lacks an effect changes too.
    """
    ratio = noise_ratio.get(floor.equation, np.inf)
    if floor.source == NEIGHBOURS and ratio * floor.stated < floor.noise:
        return floor.unrepeated(ratio * floor.stated, NEIGHBOURS)
    return _scaled(floor, noise_ratio, UNSTATED)


def noise_by_neighbours(
    conditioned: ConditionedRecord, rows: Rows, residual: Array
) -> float | None:
    """Return the noise (rms, SI) of a residual (m,) by pairs of rows at neighbouring states.

    A state is position, velocity, spool (or drive) and pressures of every moving joint, each over
    its standard deviation. None where the nearest pairs are too few or too far apart.
    """
    if len(rows.time) < DATA.least_pairs:
        return None
    states = _states(conditioned, rows)
    count = min(len(states), DATA.neighbours_asked)
    distance, neighbours = cKDTree(states).query(states, k=count)
    apart = np.abs(rows.time[neighbours] - rows.time[:, None]) > DATA.pair_time
    row = np.flatnonzero(apart.any(axis=1))
    nearest = np.argmax(apart, axis=1)[row]  # the nearest neighbour at least `pair_time` away
    distance2 = distance[row, nearest] ** 2
    pairs = np.argsort(distance2)[: int(DATA.nearest_pair_share * len(states))]
    if len(pairs) < DATA.least_pairs or distance2[pairs[-1]] > DATA.pair_distance**2:
        return None
    first, second = row[pairs], neighbours[row, nearest][pairs]
    change = residual[second] - residual[first]
    total = float(change @ change)
    line = _largest_line(rows.time[first], rows.time[second], change)
    noise2 = total - line if line > DATA.unrepeated_share * total else total
    return math.sqrt(0.5 * noise2 / len(pairs))


def _largest_line(first: Array, second: Array, change: Array) -> float:
    """Return the largest energy of one frequency in changes (m,) of a residual between instants.

    `first` and `second` (m,) [s] are the instants. Neighbouring states have any phase of a torque
    in time, which is no noise.
    """
    instants = np.unique(np.concatenate((first, second)))
    length = float(instants[-1] - instants[0])
    highest = 0.5 / float(np.min(np.diff(instants)))
    frequency = np.arange(DATA.least_turns / length, highest, DATA.line_step / length)
    best = 0.0
    for part in np.array_split(frequency, 1 + len(frequency) // LINES_AT_ONCE):
        before, after = (2.0 * np.pi * np.multiply.outer(t, part) for t in (first, second))
        waves = np.cos(after) - np.cos(before), np.sin(after) - np.sin(before)
        best = max(best, float(sine_energy(*waves, change[None]).max(initial=0.0)))
    return best


def sine_energy(c: Array, s: Array, series: Array) -> Array:
    """Return the energy (f,) that two waves each, c and s (m, f), fit in series (n, m), summed.

    Least squares with free amplitudes for each series (Lomb 1976).
    """
    cc, ss, cs = (c * c).sum(axis=0), (s * s).sum(axis=0), (c * s).sum(axis=0)
    a, b = series @ c, series @ s
    fitted = (ss * a * a - 2 * cs * a * b + cc * b * b).sum(axis=0)
    determinant = cc * ss - cs * cs
    # At multiples of half the sampling rate, sine and cosine are one column, or none.
    single = determinant <= SAME_COLUMN * (cc + ss) ** 2
    energy = (a * a + b * b).sum(axis=0) / np.maximum(cc + ss, np.finfo(np.float64).tiny)
    return np.asarray(np.where(single, energy, fitted / np.where(single, 1.0, determinant)))


def _states(conditioned: ConditionedRecord, rows: Rows) -> Array:
    """Return the moving joints' states (m, k) at the instants of rows, each of unit deviation."""
    signals, at = conditioned.signals, conditioned.samples_at(rows.time)
    kinds = (signals.q, signals.qd, signals.u, signals.p_cap, signals.p_rod)
    columns = np.column_stack([kind[np.ix_(at, signals.moving)] for kind in kinds])
    spread = columns.std(axis=0)
    return np.asarray(columns[:, spread > 0] / spread[spread > 0])


def stacked_repeats(
    conditioned: ConditionedRecord, parts: Sequence[Rows], residual: Sequence[Array]
) -> tuple[Array | None, str]:
    """Return residuals (n, m) of n repeats or periods, None without them, and their source."""
    if len(parts) > 1:
        common = parts[0].time
        for rows in parts[1:]:
            common = np.intersect1d(common, rows.time)
        if len(common) >= 10:
            table = [r[np.isin(p.time, common)] for p, r in zip(parts, residual, strict=True)]
            return np.array(table), REPEATS
    if len(parts) == 1:
        periods = _periods(conditioned, parts[0], residual[0])
        if periods is not None:
            return periods, PERIODS
    return None, STATED


def _periods(conditioned: ConditionedRecord, rows: Rows, residual: Array) -> Array | None:
    """Return a record's residual by whole period (n, m), None where there are too few.

    Of a record of less than three periods, the part in common of the first two is returned, if it
    is at least a quarter of a period. A period needs at least five rows.
    """
    period, step = conditioned.record.period, conditioned.filtering.step
    if not period or period % step or not len(rows.time):
        return None
    period_rows = period // step
    index = np.rint((rows.time - rows.time[0]) * conditioned.record.sample_rate / step).astype(int)
    periods = (int(index[-1]) + 1) // period_rows
    if periods < 3:
        least, periods = max(5, period_rows // 4), 2
    else:
        least = 5
    if period_rows < 5:
        return None
    grid = np.full(periods * period_rows, np.nan)
    inside = index < periods * period_rows
    grid[index[inside]] = residual[inside]
    table = grid.reshape(periods, period_rows)
    table = table[:, np.isfinite(table).all(axis=0)]
    return table if table.shape[1] >= least else None


def stated_noise(
    rig: Rig,
    terms: Sequence[Used],
    conditioned: ConditionedRecord,
    rows: Mapping[str, Rows],
    beta: Mapping[str, float],
    disturbed: Callable[[Rig, Record, np.random.Generator], Record] = with_added_noise,
    draws: int = 1,
) -> dict[str, float]:
    """Return the rms [SI] of each equation's residual by noise of the rig's sensors alone.

    `disturbed` adds that noise to a record, by default all that the rig file states; the rms is
    over `draws` of it.
    """
    rng = np.random.default_rng(0)  # fixed seed: the prediction is the same every time
    squares: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(draws):
        drawn = _noise_rows(rig, terms, conditioned, rows, beta, disturbed, rng)
        for name, (_, change) in drawn.items():
            if len(change):
                squares[name].append(float(np.mean(change**2)))
    return {n: float(np.sqrt(np.mean(drawn))) if drawn else NO_ROWS for n, drawn in squares.items()}


def _noise_rows(
    rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord, rows: Mapping[str, Rows],
    beta: Mapping[str, float], disturbed: Callable[[Rig, Record, np.random.Generator], Record],
    rng: np.random.Generator,
) -> dict[str, tuple[NDArray[np.int64] | slice, Array]]:  # fmt: skip
    """Return of each equation the rows that noise leaves valid, and its residual (m,) of noise."""
    noisy = disturbed(rig, conditioned.record, rng)
    after = model_rows(rig, terms, conditioned.condition_alike(rig, noisy))
    out = {}
    for name, before in rows.items():
        in_before, in_after = in_common(before, after[name])
        quiet, changed = row_residual(before, beta), row_residual(after[name], beta)
        out[name] = in_before, changed[in_after] - quiet[in_before]
    return out
