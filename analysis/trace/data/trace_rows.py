"""The runs of a trace by their task, and their rows: fitted, choosing and judging ones.

Repeats are averaged, and what differs between them counts as noise. Neither holds where the motion
differs, for example where a recording did not start with the excitation: such a repeat becomes a
step of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Filtering, Line
from analysis.terms.base import Used
from analysis.trace.data.cache import RowCache
from analysis.trace.data.conditioned_record import conditioned_records, trace_filtering
from analysis.trace.data.nuisance_terms import path_terms
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import TraceRows, set_aside
from analysis.trace.settings import DATA, TRACE
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.records import Record, Run, bandwidth_of, of_bandwidth
from rig.model.rig import Rig
from rig.model.units import plain

WHY_MASKED: Final = "a pressure lies outside 0 to the supply's, or samples were clipped or lost"


@dataclass(frozen=True)
class TraceRuns:
    """Runs of a rig by their task, the model's terms, and the families of equations to trace.

    Sines at `lines` (joint, 0-based, and frequency [Hz]) are taken out of the torque balances;
    `noise_ratio` is by equation that of the noise to the stated noise where nothing repeats.
    """

    rig: Rig
    terms: tuple[Used, ...]
    train: tuple[Run, ...]
    holdout: tuple[Run, ...]
    judge: tuple[Run, ...]
    families: tuple[str, ...]
    lines: tuple[Line, ...] = ()
    noise_ratio: Mapping[str, float] = field(default_factory=dict)

    @property
    def unseen(self) -> tuple[Run, ...]:
        """The runs that no parameter is fitted to."""
        return (*self.holdout, *self.judge)

    @property
    def bandwidth(self) -> float | None:
        """Frequency [Hz] below which the motion of records without excited lines is."""
        return bandwidth_of([*self.train, *self.unseen])

    def of_rig(self, rig: Rig) -> TraceRuns:
        """Return the runs as records of another rig."""
        changed = self._changed(lambda runs: tuple(replace(run, rig=rig) for run in runs))
        return replace(changed, rig=rig)

    def of_bandwidth(self, width: float) -> TraceRuns:
        """Return the runs with another bandwidth [Hz], which the filter of their rows follows."""
        return self._changed(lambda runs: of_bandwidth(runs, width))

    def _changed(self, change: Callable[[tuple[Run, ...]], tuple[Run, ...]]) -> TraceRuns:
        train, holdout, judge = map(change, (self.train, self.holdout, self.judge))
        return replace(self, train=train, holdout=holdout, judge=judge)


def trace_rows(
    records: TraceRuns, filtering: Callable[[Record], Filtering] = trace_filtering,
    cache: RowCache | None = None,
) -> TraceRows:  # fmt: skip
    """Return the whitened rows of all runs under their model.

    `filtering` gives the row filter of each record; `cache` may hold training rows under the same
    filters. Coefficients are fitted to the training rows.
    Raises InputError where a step leaves too few rows of an equation (`_without_short_steps`).
    """

    def filters(record: Record) -> Filtering:
        return replace(filtering(record), lines=records.lines)

    def conditioned(runs: Sequence[Run]) -> list[ConditionedRecord]:
        return conditioned_records(records.rig, runs, filters, records.families)

    train_data = _training_rows(records, conditioned(records.train), cache)

    def unseen_rows(members: Sequence[ConditionedRecord]) -> RegressionData:
        return regression_data(
            records.rig, train_data.terms, members, train_data.beta,
            others=train_data.floors, noise_ratio=records.noise_ratio,
        )  # fmt: skip

    members = conditioned(records.holdout)
    data = unseen_rows(members)
    if not records.judge:
        return set_aside(train_data, data, members, records.holdout)
    members = conditioned(records.judge)
    judging = unseen_rows(members)
    return TraceRows(train_data, data, judging, tuple(members), records.holdout)


def _training_rows(
    records: TraceRuns, train: Sequence[ConditionedRecord], cache: RowCache | None
) -> RegressionData:
    """Return the training rows, with the columns of the spools' paths between samples."""

    def rows(terms: tuple[Used, ...]) -> RegressionData:
        ratio = records.noise_ratio
        data = regression_data(records.rig, terms, train, cache=cache, noise_ratio=ratio)
        return _without_short_steps(data)

    data = rows(records.terms)
    paths = path_terms(data)
    return rows((*records.terms, *paths)) if paths else data


def _without_short_steps(train_data: RegressionData) -> RegressionData:
    """Return the rows without those equations of a step of which it leaves too few.

    Raises InputError where a step leaves fewer than `TRACE.least_rows` rows of an equation and no
    other step has more.
    """
    least = TRACE.least_rows
    short = [s for s in train_data.segments if s.count < least]
    equations_elsewhere = {s.equation for s in train_data.segments if s not in short}
    used_rows = np.ones(train_data.base.shape[0], dtype=bool)
    for s in short:
        if s.equation in equations_elsewhere:
            used_rows[s.where] = False
            continue
        count = s.count
        conditioned, rows = train_data.source(s)
        record, masked = conditioned.record, rows.masked
        remedy = "take longer records"
        if masked > count:
            remedy = (
                f"{masked} others are masked, since {WHY_MASKED}: move less, or check the "
                "sensors' ranges"
            )
        raise InputError(
            f"step {s.group[1]!r}: records of {record.samples / record.sample_rate:.3g} s "
            f"leave {count} rows of {s.equation}; the trace needs {least}: {remedy}"
        )
    return train_data if used_rows.all() else train_data.at(used_rows)


def with_other_motions_apart(runs: Sequence[Run]) -> tuple[list[Run], tuple[str, ...]]:
    """Return the runs with repeats of another motion as steps of their own, and notes on them.

    A repeat has another motion where a joint's position differs from that in the step's first
    record by more than `DATA.other_motion` of the standard deviation of the latter.
    """
    out, notes = [], []
    for run in runs:
        first: dict[str, Record] = {}
        records = []
        for record in run.records:
            difference = _motion_difference(run.rig, first.setdefault(record.step, record), record)
            if difference > DATA.other_motion:
                notes.append(
                    f"step {record.step!r}: repeat {record.repeat} differs from the first by "
                    f"{plain(100 * difference, 2)} % of its motion and is taken as a step of its "
                    "own: records of one step must start at the same sample of one excitation"
                )
                records.append(replace(record, step=f"{record.step} repeat {record.repeat}"))
            else:
                records.append(record)
        out.append(replace(run, records=tuple(records)))
    return out, tuple(notes)


def _motion_difference(rig: Rig, first: Record, other: Record) -> float:
    """Return the largest of the free joints' rms differences over the deviation in `first`."""
    noise = rig.sensors.of(rig.position_kind).noise
    largest = 0.0
    for joint in range(1, len(rig.joints) + 1):
        name = ch.channel(rig.position_kind, joint)
        x, y = first.channels[name], other.channels[name]
        count = min(len(x), len(y))
        motion = float(np.std(x[:count]))
        if joint not in first.locked and motion > DATA.seen_motion * noise:
            change = float(np.std(y[:count] - x[:count]))
            largest = max(largest, change / motion)
    return largest
