"""The records of runs, conditioned: filtered signals, with one decision on the locks per step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.regression.rows import Array, Filtering, Indices, default_filtering
from analysis.signals.conditioning import Signals, condition, without_rests
from analysis.signals.locks import bands_by_step
from analysis.terms.base import FAMILIES
from rig.model.records import Record, Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class ConditionedRecord:
    """A conditioned record: its filtered signals, its filters, the equations it is used for.

    `run` numbers the run; `families` are the families of rows that are used, by default all. An
    average of repeats that moved differently has these as `repeats`: its rows are the mean of
    theirs, since a product of averaged signals is not the average of the products.
    """

    run: int
    record: Record
    signals: Signals
    filtering: Filtering
    families: tuple[str, ...] = tuple(FAMILIES)
    repeats: tuple[ConditionedRecord, ...] = ()

    def condition_alike(self, rig: Rig, record: Record) -> ConditionedRecord:
        """Condition another record (averaged repeats, added noise) with this one's settings."""
        signals = _weighted_signals(rig, record, self.filtering, self.signals.bands)
        return replace(self, record=record, signals=signals, repeats=())

    def with_changed_signals(self, change: Callable[[Signals], Signals]) -> ConditionedRecord:
        """Return the record with changed signals, those of its repeats too."""
        repeats = tuple(repeat.with_changed_signals(change) for repeat in self.repeats)
        return replace(self, signals=change(self.signals), repeats=repeats)

    def samples_at(self, time: Array) -> Indices:
        """Return the indices of the samples (m,) nearest to the times (m,) [s]."""
        nearest = np.rint(time * self.record.sample_rate).astype(np.int64)
        return np.asarray(nearest.clip(0, len(self.signals.t) - 1))

    @property
    def group(self) -> tuple[int, str]:
        """The (run, step) that the repeat belongs to."""
        return self.run, self.record.step

    @property
    def key(self) -> tuple[int, str, int]:
        """The run, the step and the number of the repeat."""
        return self.run, self.record.step, self.record.repeat


def condition_runs(
    rig: Rig,
    runs: Sequence[Run],
    filtering: Callable[[Record], Filtering] = default_filtering,
    families: tuple[str, ...] = tuple(FAMILIES),
) -> list[ConditionedRecord]:
    """Condition every record of the runs, in their order; raises InputError as `condition` does."""
    out = []
    for number, run in enumerate(runs):
        bands = bands_by_step(rig, run.records)
        for record in run.records:
            filters = filtering(record)
            signals = _weighted_signals(rig, record, filters, bands[record.step])
            out.append(ConditionedRecord(number, record, signals, filters, families))
    return out


def _weighted_signals(rig: Rig, record: Record, filters: Filtering, bands: Array) -> Signals:
    """Return a record's signals, with weights 0 at rest for the joints `in_motion`.

    The weight goes by the record's own speed: w(s') times s'' is the rate of a function of s', from
    which the row filter removes fast noise. The noise of another record would remain.
    """
    signals = condition(rig, record, filters.channels, bands)
    if not filters.in_motion:
        return signals
    return without_rests(signals, filters.in_motion, filters.full_weight)
