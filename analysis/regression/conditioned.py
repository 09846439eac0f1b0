"""The records of runs, conditioned: filtered signals, with one decision a step on its locks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from analysis.regression.rows import Filtering, default_filtering
from analysis.signals.conditioning import Signals, condition
from analysis.signals.locks import moving_by_step
from analysis.terms.base import FAMILIES
from rig.model.records import Record, Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class ConditionedRecord:
    """One record made ready: its signals under the channel filter, its filters, its equations.

    `run` numbers the run; `families` are the families of rows that are looked at, by default all.
    """

    run: int
    record: Record
    signals: Signals
    filtering: Filtering
    families: tuple[str, ...] = tuple(FAMILIES)

    @property
    def group(self) -> tuple[int, str]:
        """Which repeats belong together: the run and the step."""
        return self.run, self.record.step


def condition_runs(
    rig: Rig,
    runs: Sequence[Run],
    filtering: Callable[[Record], Filtering] = default_filtering,
    families: tuple[str, ...] = tuple(FAMILIES),
) -> list[ConditionedRecord]:
    """Condition every record of the runs, in their order; raises InputError as `condition` does."""
    out = []
    for number, run in enumerate(runs):
        moving = moving_by_step(rig, run.records)
        for record in run.records:
            filters = filtering(record)
            signals = condition(rig, record, filters.channels, moving[record.step])
            out.append(ConditionedRecord(number, record, signals, filters, families))
    return out
