"""Rows of the regression: every term's columns in every equation of one record.

Used are the torque rows and the chamber-flow rows of the excited joints only: a locked joint's
contact torque is unknown, and its valve is shut. Rows are built point by point from the filtered
signals, then whole rows pass the row filter and are decimated (`analysis.signals.filters` says
why). Sum of columns times coefficients = right-hand side; units: torque_i [N m], flow_* [m^3/s].
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.regression.settings import REGRESSION
from analysis.signals.conditioning import Mask, Signals
from analysis.signals.convolution import decimated
from analysis.signals.filters import (
    FirSmoother,
    Smoother,
    band_filter,
    butterworth,
    channel_filter,
    moving_average,
    row_filter,
    row_step,
)
from analysis.terms.base import FAMILIES, Used, equation
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
WAVES = (np.sin, np.cos)
Line = tuple[int, float]  # joint (0-based) and frequency [Hz]


@dataclass(frozen=True)
class Filtering:
    """The filters of one record: `channels` before, `rows` (or none) after the rows are built.

    Torque balances of joints `in_motion` (0-based) have weight 0 at rest and 1 above `full_weight`
    times the record's rms speed. From those of the joints in `lines` (0-based, with a frequency
    [Hz]) the part at that frequency is removed: a sine of free amplitude and phase is fitted to
    every record and subtracted.
    """

    channels: Smoother
    rows: FirSmoother | None
    step: int = 1
    in_motion: tuple[int, ...] = ()
    full_weight: float = 1.0
    lines: tuple[Line, ...] = ()


@dataclass(frozen=True)
class Rows:
    """Rows of one equation of one record: matrix (m, k), rhs (m,), time [s] of each row (m,).

    `names` are the parameters of the columns; `masked` rows were dropped because a sample within
    reach of the filter lay outside the model, was clipped or was lost.
    """

    equation: str
    names: tuple[str, ...]
    matrix: Array
    rhs: Array
    time: Array
    masked: int

    def at(self, mask: Mask) -> Rows:
        """Return the rows where a mask (m,) is true."""
        return replace(self, matrix=self.matrix[mask], rhs=self.rhs[mask], time=self.time[mask])


def matrix_of(rows: Rows, names: tuple[str, ...]) -> Array:
    """Return the columns (m, k) of parameters, 0 for those that the rows lack."""
    if rows.names[: len(names)] == names:
        return rows.matrix[:, : len(names)]
    out = np.zeros((len(rows.rhs), len(names)))
    present = [k for k, name in enumerate(names) if name in rows.names]
    out[:, present] = rows.matrix[:, [rows.names.index(names[k]) for k in present]]
    return out


def in_common(rows: Rows, other: Rows) -> tuple[Indices | slice, Indices | slice]:
    """Return, for each of two sets of rows, the indices of the instants that both have."""
    if np.array_equal(rows.time, other.time):  # nearly always
        return slice(None), slice(None)
    _, indices, others = np.intersect1d(rows.time, other.time, return_indices=True)
    return indices, others


def mean_rows(repeats: Sequence[Mapping[str, Rows]]) -> dict[str, Rows]:
    """Return the mean of the repeats' rows of each equation, at the instants that all have."""
    out = {}
    for name in repeats[0]:
        parts = [rows[name] for rows in repeats if name in rows]
        if len(parts) < len(repeats):
            continue
        time = functools.reduce(np.intersect1d, (rows.time for rows in parts))
        parts = [rows.at(np.isin(rows.time, time)) for rows in parts]
        names = tuple(dict.fromkeys(n for rows in parts for n in rows.names))
        matrix = np.mean([matrix_of(rows, names) for rows in parts], axis=0)
        rhs = np.mean([rows.rhs for rows in parts], axis=0)
        out[name] = Rows(name, names, matrix, rhs, time, max(rows.masked for rows in parts))
    return out


def default_filtering(record: Record) -> Filtering:
    """Return the default filters, adapted to the record's excitation."""
    rate, cutoff = record.sample_rate, rows_cutoff(record)
    return Filtering(channel_filter(rate), row_filter(rate, cutoff), row_step(rate, cutoff))


def filtering_above_rows(record: Record, filtering: Filtering) -> Filtering:
    """Return filters of rows that pass the octave above the default filter of rows."""
    rows = band_filter(record.sample_rate, REGRESSION.octave_above * rows_cutoff(record))
    return replace(filtering, rows=rows)


def rows_cutoff(record: Record) -> float:
    """Return the cutoff [Hz] of the default filter of rows, adapted to the record's excitation."""
    if record.period and record.lines:
        return lines_cutoff(record)
    if ch.channel(ch.POSITION, 1) in record.channels:
        return REGRESSION.row_cutoff_electric
    if record.bandwidth is not None:
        return _cutoff(record.bandwidth, REGRESSION.slow_bandwidth, REGRESSION.row_cutoff)
    return REGRESSION.row_cutoff


def lines_cutoff(record: Record) -> float:
    """Return the row filter's cutoff [Hz] for a record whose excited lines are known."""
    highest = max(record.lines) * record.sample_rate / record.period
    several = len(record.lines) >= REGRESSION.multisine_lines
    slow = REGRESSION.slow_lines if several else np.inf
    return _cutoff(highest, slow, REGRESSION.row_cutoff_range[1])


def _cutoff(highest: float, slow: float, most: float) -> float:
    """Return the row filter's cutoff [Hz] for motion up to `highest` [Hz], at most `most` [Hz].

    The lower limit is `slow` times `highest` where that is less than the usual one.
    """
    least = min(REGRESSION.row_cutoff_range[0], slow * highest)
    return float(np.clip(REGRESSION.lines_factor * highest, least, most))


def paper_filtering(record: Record) -> Filtering:
    """Return the paper's filters: 20-sample average (zero-phase here), differences, every row."""
    return Filtering(moving_average(record.sample_rate), None)


def butterworth_filtering(record: Record) -> Filtering:
    """Return filters with a zero-phase Butterworth on the channels."""
    chosen = default_filtering(record)
    cutoff = min(80.0, 0.2 * record.sample_rate)
    return replace(chosen, channels=butterworth(record.sample_rate, cutoff))


FILTERINGS: dict[str, Callable[[Record], Filtering]] = {
    "default": default_filtering,
    "moving-average": paper_filtering,
    "butterworth": butterworth_filtering,
}


def right_sides(rig: Rig, signals: Signals) -> dict[str, Array]:
    """Return the right-hand side (n,) of every equation."""
    kinds = [kind for family in rig.families for kind in FAMILIES[family]]
    return {
        equation(kind, i): right_side(rig, signals, kind, i)
        for kind in kinds
        for i in range(signals.joints)
    }


def right_side(rig: Rig, signals: Signals, kind: str, i: int) -> Array:
    """Return joint i's (0-based) right-hand side (n,): G F, A_cap ds/dt or - A_rod ds/dt.

    An electric joint has its drive's torque or force alone: gain times drive.

    The torque is G F, by virtual work; Sakai and Maeshima's regressor prints the inverse of G.
    """
    if "fluid" not in rig.families:
        return np.asarray(rig.drive_gains[i] * signals.u[:, i])
    cylinder = rig.joints[i].cylinder
    cap, rod = cylinder.cap_area, cylinder.rod_area
    if kind == "flow_cap":
        return np.asarray(cap * signals.sd[:, i])
    if kind == "flow_rod":
        return np.asarray(-rod * signals.sd[:, i])
    return np.asarray(signals.G[:, i] * (cap * signals.p_cap[:, i] - rod * signals.p_rod[:, i]))


def parameters_of(rig: Rig, terms: Sequence[Used], family: str) -> tuple[str, ...]:
    """Return the parameters that the terms put into one family's rows, in the terms' order."""
    names = {
        c.parameter: None
        for used in terms
        for c in used.term.coefficients(rig)
        if c.family == family
    }
    return tuple(names)


def prepared(rig: Rig, terms: Sequence[Used], signals: Signals) -> Signals:
    """Return the signals as the terms' columns see them, after every term's preparation in turn."""
    for used in terms:
        signals = used.term.prepare(rig, signals, used.shape)
    return signals


def record_rows(
    rig: Rig,
    terms: Sequence[Used],
    signals: Signals,
    filtering: Filtering,
    families: Collection[str] = tuple(FAMILIES),
    within: tuple[float, float] = (-np.inf, np.inf),
) -> dict[str, Rows]:
    """Return the filtered rows of every equation of the excited joints of one record.

    Only those of `families`, and only rows whose time [s] lies `within` (from, before), for a chunk
    of a longer record.
    """
    measured, signals = signals, prepared(rig, terms, signals)
    out: dict[str, Rows] = {}
    for family in families:
        sides = right_parts(rig, signals, filtering, family)
        parts = [term_part(rig, used, signals, filtering, family, measured) for used in terms]
        out |= assembled(parameters_of(rig, terms, family), parts, sides, filtering, within)
    return out


@dataclass(frozen=True)
class TermPart:
    """A term's filtered columns (m,) by equation and parameter, before rows are dropped.

    `valid` (n,) states, by equation, where the term's equation holds.
    """

    columns: dict[str, dict[str, Array]]
    valid: dict[str, Mask]


@dataclass(frozen=True)
class RightPart:
    """An equation's filtered right side and its instants (m,) [s], before rows are dropped.

    `sensors` (n,) states where its sensors are valid, `lost` (n,) where a sample never arrived;
    `sines` (m, 2 l) are the sines and cosines of the l frequencies to be removed.
    """

    side: Array
    time: Array
    sensors: Mask
    lost: Mask
    sines: Array


def _equations(signals: Signals, family: str) -> list[str]:
    return [equation(kind, i) for i in signals.excited_joints for kind in FAMILIES[family]]


def term_part(
    rig: Rig, used: Used, signals: Signals, filtering: Filtering, family: str, measured: Signals
) -> TermPart:
    """Return a term's filtered columns of one family, of signals as all terms see them.

    Where the equations hold is decided by the `measured` signals, before any term corrects them.
    """
    equations = _equations(signals, family)
    raw = used.term.columns(rig, signals, used.shape)
    valid = used.term.valid(rig, measured, used.shape)
    return TermPart(
        {e: low_passed(weighted(raw[e], signals, e), filtering) for e in equations if raw.get(e)},
        {e: valid[e] for e in equations if e in valid},
    )


def weighted(columns: Mapping[str, Array], signals: Signals, name: str) -> Mapping[str, Array]:
    """Return an equation's columns (n,) multiplied by the weight of each sample."""
    kind, number = name.rsplit("_", 1)
    if signals.weight is None or kind != "torque":
        return columns
    weight = signals.weight[:, int(number) - 1]
    return {parameter: weight * column for parameter, column in columns.items()}


def right_parts(
    rig: Rig, signals: Signals, filtering: Filtering, family: str
) -> dict[str, RightPart]:
    """Return the right sides of one family's equations of the excited joints."""
    out: dict[str, RightPart] = {}
    if family not in rig.families:
        return out
    for name in _equations(signals, family):
        kind, number = name.rsplit("_", 1)
        i = int(number) - 1
        # Inertia couples the joints: a clipped piston of any joint affects every torque row.
        joints = range(signals.joints) if family == "mechanical" else (i,)
        raw = {"": right_side(rig, signals, kind, i)}
        side = low_passed(weighted(raw, signals, name), filtering)[""]
        time = instants(signals.t, filtering, len(side))
        sensors = _over_joints(np.logical_and, signals.valid, joints)
        if family == "fluid":  # below zero the oil cavitates, and the flow balance does not hold
            p = (signals.p_cap if kind == "flow_cap" else signals.p_rod)[:, i]
            sensors = sensors & (p >= 0.0)
        sines = filtered_sines(signals, filtering, name)
        lost = _over_joints(np.logical_or, signals.lost, joints)
        out[name] = RightPart(side, time, sensors, lost, sines)
    return out


def _over_joints(ufunc: np.ufunc, mask: Mask, joints: Sequence[int]) -> Mask:
    """Return a mask (n,) of some joints' columns (n, N); a reduction along short rows is slow."""
    return np.asarray(functools.reduce(ufunc, (mask[:, joint] for joint in joints)))


def filtered_sines(signals: Signals, filtering: Filtering, name: str) -> Array:
    """Return the sines and cosines (m, 2 l) removed from an equation's rows, as filtered."""
    frequencies = [f for joint, f in filtering.lines if equation("torque", joint) == name]
    angles = [2 * np.pi * f * signals.t for f in frequencies]
    waves = {f"{wave.__name__} {k}": wave(x) for k, x in enumerate(angles) for wave in WAVES}
    if not waves:
        return np.zeros((0, 0))
    return np.column_stack(list(low_passed(weighted(waves, signals, name), filtering).values()))


def sines_at(rows: Rows, signals: Signals, filtering: Filtering) -> Array:
    """Return the sines and cosines (m, 2 l) removed from rows, at the rows' instants."""
    sines = filtered_sines(signals, filtering, rows.equation)
    return sines[places_of(rows, signals, filtering)] if sines.size else sines


def without_sines(columns: Array, sines: Array) -> Array:
    """Return columns (m, k) or (m,) less their least-squares fit by the sines (m, l)."""
    if not sines.size:
        return columns
    return np.asarray(columns - sines @ np.linalg.lstsq(sines, columns, rcond=None)[0])


def assembled(
    names: tuple[str, ...],
    parts: Sequence[TermPart],
    sides: Mapping[str, RightPart],
    filtering: Filtering,
    within: tuple[float, float] = (-np.inf, np.inf),
) -> dict[str, Rows]:
    """Assemble one family's rows, by equation, without those that are masked."""
    out = {}
    for name, right in sides.items():
        invalid = ~right.sensors
        for part in parts:
            if name in part.valid:
                invalid = invalid | ~part.valid[name]
        inside = (right.time >= within[0]) & (right.time < within[1])
        dropped = _dropped(invalid, right.lost, filtering, len(right.side))
        kept = inside & ~dropped
        matrix = columns_at(names, parts, name, np.flatnonzero(kept))
        masked = int((inside & dropped).sum())
        sines = right.sines[kept] if right.sines.size else right.sines
        matrix, side = without_sines(matrix, sines), without_sines(right.side[kept], sines)
        out[name] = Rows(name, names, matrix, side, right.time[kept], masked)
    return out


def columns_at(
    names: Sequence[str], parts: Sequence[TermPart], equation: str, at: Indices
) -> Array:
    """Return the columns (m, k) `names` of one equation, summed over terms, at the rows `at`."""
    matrix = np.zeros((len(at), len(names)))
    for part in parts:
        for parameter, column in part.columns.get(equation, {}).items():
            matrix[:, names.index(parameter)] += column[at]
    return matrix


def low_passed(columns: Mapping[str, Array], filtering: Filtering) -> dict[str, Array]:
    """Filter and decimate columns (n,) by name, before rows are dropped."""
    stack = _inside(np.array(list(columns.values())).T, filtering)
    if filtering.rows is None:
        stack = stack[:: filtering.step]
    else:
        stack = filtering.rows.decimate(stack, filtering.step)
    return dict(zip(columns, stack.T, strict=True))


def instants(time: Array, filtering: Filtering, count: int) -> Array:
    """Return the instants of the first `count` filtered rows of samples at `time` (n,)."""
    step, start = filtering.step, 0
    if filtering.rows is not None:
        start = -(-2 * filtering.rows.reach // step) * step - filtering.rows.reach
    return _inside(time, filtering)[start + step * np.arange(count)]


def places_of(rows: Rows, signals: Signals, filtering: Filtering) -> Indices:
    """Return the indices (m,) of rows among all filtered rows of their record."""
    if not len(rows.time):
        return np.zeros(0, dtype=np.int64)
    elapsed = rows.time - instants(signals.t, filtering, 1)
    return np.asarray(np.rint(elapsed * signals.rate / filtering.step), dtype=np.int64)


def _inside(x: NDArray[Any], filtering: Filtering) -> NDArray[Any]:
    """Return samples (n, ...) without those affected by the channel filter's edges."""
    edges = filtering.channels.reach
    return x[edges : len(x) - edges]


def _dropped(invalid: Mask, lost: Mask, filtering: Filtering, count: int) -> Mask:
    """Return which filtered rows (m,) have a masked sample within the filter's reach."""
    invalid, lost = _inside(invalid, filtering), _inside(lost, filtering)
    if filtering.rows is None:
        return np.asarray((invalid | lost)[:: filtering.step])
    dropped = np.zeros(count, dtype=bool)
    weights = np.abs(filtering.rows.taps[0]) / np.abs(filtering.rows.taps[0]).sum()
    # A lost sample is interpolated: not even the filter's tails may include it.
    for mask, taps, limit in (
        (invalid, weights, REGRESSION.masked_share),
        (lost, np.ones(len(weights)), 0.5),
    ):
        if mask.any():
            dropped |= decimated(mask.astype(np.float64), taps, filtering.step) > limit
    return dropped
