"""Rows of the regression: what every term says about every equation of one record.

Used are the torque rows and the chamber-flow rows of the excited joints only: a locked joint's
contact torque is unknown, and its valve is shut. Rows are built point by point from the filtered
signals, then whole rows pass the row filter and are decimated (`analysis.signals.filters` says
why). Sum of columns times coefficients = right-hand side; units: torque_i [N m], flow_* [m^3/s].
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.regression.settings import REGRESSION
from analysis.signals.conditioning import Mask, Signals
from analysis.signals.convolution import decimated
from analysis.signals.filters import (
    FirSmoother,
    Smoother,
    butterworth,
    channel_filter,
    moving_average,
    row_filter,
    row_step,
)
from analysis.terms.base import FAMILIES, Columns, Used, equation
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Filtering:
    """The filters of one record: `channels` before, `rows` (or none) after."""

    channels: Smoother
    rows: FirSmoother | None
    step: int = 1


@dataclass(frozen=True)
class Rows:
    """Rows of one equation of one record: matrix (m, k), rhs (m,), time [s] of each row (m,).

    `names` are the parameters of the columns; `masked` rows were dropped because a sample under
    the filter lay outside the model, was clipped or was lost.
    """

    equation: str
    names: tuple[str, ...]
    matrix: Array
    rhs: Array
    time: Array
    masked: int


def in_common(one: Rows, other: Rows) -> tuple[Indices, Indices]:
    """Return the places in either of the instants that two sets of rows have in common."""
    if np.array_equal(one.time, other.time):  # nearly always
        at = np.arange(len(one.time))
        return at, at
    _, here, there = np.intersect1d(one.time, other.time, return_indices=True)
    return here, there


def default_filtering(record: Record) -> Filtering:
    """Return the filters that the bias study chose, fitted to the record's excitation."""
    rate = record.sample_rate
    cutoff = (
        REGRESSION.row_cutoff_electric
        if ch.channel(ch.POSITION, 1) in record.channels
        else REGRESSION.row_cutoff
    )
    if record.period and record.lines:
        cutoff = lines_cutoff(record)
    return Filtering(channel_filter(rate), row_filter(rate, cutoff), row_step(rate, cutoff))


def lines_cutoff(record: Record) -> float:
    """Return the row filter's cutoff [Hz] for a record whose excited lines are known."""
    highest = max(record.lines) * record.sample_rate / record.period
    return float(np.clip(REGRESSION.lines_factor * highest, *REGRESSION.row_cutoff_range))


def paper_filtering(record: Record) -> Filtering:
    """Return the paper's: a 20-sample average (zero-phase here), differences, every row used."""
    return Filtering(moving_average(record.sample_rate), None)


def butterworth_filtering(record: Record) -> Filtering:
    """Return a zero-phase Butterworth on the channels in place of the windowed sinc."""
    chosen = default_filtering(record)
    cutoff = min(80.0, 0.2 * record.sample_rate)
    return replace(chosen, channels=butterworth(record.sample_rate, cutoff))


FILTERINGS: dict[str, Callable[[Record], Filtering]] = {
    "default": default_filtering,
    "moving-average": paper_filtering,
    "butterworth": butterworth_filtering,
}


def right_sides(rig: Rig, signals: Signals) -> dict[str, Array]:
    """Return the right-hand side (n,) of every equation: G F, A_cap ds/dt, - A_rod ds/dt.

    An electric joint has its drive's torque or force alone: gain times drive.

    The torque is G F, by virtual work; Sakai and Maeshima's regressor prints the inverse of G.
    """
    gains = rig.drive_gains
    sides = {equation("torque", i): gain * signals.u[:, i] for i, gain in enumerate(gains)}
    if "fluid" not in rig.families:
        return sides
    for i, joint in enumerate(rig.joints):
        cap, rod = joint.cylinder.cap_area, joint.cylinder.rod_area
        force = cap * signals.p_cap[:, i] - rod * signals.p_rod[:, i]
        sides[equation("torque", i)] = signals.G[:, i] * force
        sides[equation("flow_cap", i)] = cap * signals.sd[:, i]
        sides[equation("flow_rod", i)] = -rod * signals.sd[:, i]
    return sides


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
    """Return the signals as the terms' columns see them, each term having prepared them in turn."""
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
    return rows_of_prepared(rig, terms, prepared(rig, terms, signals), filtering, families, within)


def rows_of_prepared(
    rig: Rig,
    terms: Sequence[Used],
    signals: Signals,
    filtering: Filtering,
    families: Collection[str] = tuple(FAMILIES),
    within: tuple[float, float] = (-np.inf, np.inf),
) -> dict[str, Rows]:
    """Return the same of signals that the terms have prepared already."""
    columns: Columns = {}
    valid: dict[str, Mask] = {}
    for used in terms:
        for name, more in used.term.columns(rig, signals, used.shape).items():
            here = columns.setdefault(name, {})
            here.update({p: here[p] + v if p in here else v for p, v in more.items()})
        for name, mask in used.term.valid(rig, signals, used.shape).items():
            valid[name] = valid.get(name, np.ones(len(mask), dtype=bool)) & mask
    sides = right_sides(rig, signals)
    out = {}
    for family, kinds in FAMILIES.items():
        if family not in families:
            continue
        names = parameters_of(rig, terms, family)
        for i in map(int, np.flatnonzero(signals.excited)):
            # Inertia couples: a clipped piston of any joint spoils every torque row.
            whole = family == "mechanical"
            sensors = np.asarray(signals.valid.all(axis=1) if whole else signals.valid[:, i])
            lost = _lost(signals, slice(None) if whole else slice(i, i + 1))
            for kind in kinds:
                name = equation(kind, i)
                if name not in sides:
                    continue
                masks = Masks(~(sensors & valid.get(name, sensors)), lost)
                rows = _filtered(
                    name, names, columns.get(name, {}), sides[name], masks, signals.t, filtering
                )
                out[name] = rows.kept(names, within)
    return out


def _lost(signals: Signals, joints: slice) -> Mask:
    if signals.lost is None:
        return np.zeros(len(signals.t), dtype=bool)
    return np.asarray(signals.lost[:, joints].any(axis=1))


@dataclass(frozen=True)
class Masks:
    """Samples (n,) outside the model or clipped, and samples that never arrived."""

    bad: Mask
    lost: Mask


@dataclass(frozen=True)
class _Filtered:
    """One equation's filtered columns and right side (m, filled + 1), before rows are dropped."""

    equation: str
    filled: list[int]
    stack: Array
    dropped: Mask
    time: Array

    def kept(self, names: tuple[str, ...], within: tuple[float, float]) -> Rows:
        """Return the rows within a stretch of time, without the dropped ones."""
        inside = (self.time >= within[0]) & (self.time < within[1])
        kept = inside & ~self.dropped
        matrix = np.zeros((int(kept.sum()), len(names)))
        matrix[:, self.filled] = self.stack[kept, :-1]
        masked = int((inside & self.dropped).sum())
        return Rows(self.equation, names, matrix, self.stack[kept, -1], self.time[kept], masked)


def _filtered(
    name: str,
    names: tuple[str, ...],
    columns: dict[str, Array],
    side: Array,
    masks: Masks,
    time: Array,
    filtering: Filtering,
) -> _Filtered:
    """Filter and decimate one equation's columns and right side together."""
    edges = filtering.channels.reach
    inside = slice(edges, len(side) - edges)
    filled = [k for k, parameter in enumerate(names) if parameter in columns]
    stack = np.column_stack([*(columns[names[k]] for k in filled), side])[inside]
    masks, time = Masks(masks.bad[inside], masks.lost[inside]), time[inside]
    if filtering.rows is None:
        dropped, every = masks.bad | masks.lost, slice(None, None, filtering.step)
        return _Filtered(name, filled, stack[every], dropped[every], time[every])
    stack, dropped, time = _low_passed(stack, masks, time, filtering.rows, filtering.step)
    return _Filtered(name, filled, stack, dropped, time)


def _low_passed(
    stack: Array, masks: Masks, time: Array, rows: FirSmoother, step: int
) -> tuple[Array, Mask, Array]:
    filtered = rows.decimate(stack, step)
    start = -(-2 * rows.reach // step)
    centres = start * step - rows.reach + step * np.arange(len(filtered))
    dropped = np.zeros(len(filtered), dtype=bool)
    weights = np.abs(rows.taps[0]) / np.abs(rows.taps[0]).sum()
    # What stands for a lost sample is made up: not even the filter's tails may touch it.
    for mask, taps, limit in (
        (masks.bad, weights, REGRESSION.masked_share),
        (masks.lost, np.ones(len(weights)), 0.5),
    ):
        if mask.any():
            dropped |= decimated(mask.astype(np.float64), taps, step) > limit
    return filtered, dropped, time[centres]
