"""Hold-out rows: those that choose between effects, and those that judge.

The error of choosing rows is too small for the effects chosen by them. Where no records are given
to judge, the second of every three blocks of `DATA.judging_block` of each held-out record is
therefore set aside: its rows are read once, after everything is chosen. Rows are weighted by the
noise floor of the whole record, since periods and neighbouring states cannot be found within
blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Filtering
from analysis.trace.data.noise_floor import Group
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.settings import DATA, TRACE
from rig.model.parse import InputError
from rig.model.records import Run, samples_digest

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def in_judging_block(time: Array) -> Mask:
    """Return whether each instant (n,) [s] of a record lies in a block that is set aside."""
    return np.asarray(np.floor(time / DATA.judging_block) % 3 == 1)


@dataclass(frozen=True)
class TraceRows:
    """Rows that are fitted (`train`), that choose between effects, and that judge.

    `members` are the records of the judging rows, each repeat by itself; of those whose group is in
    `divided`, only the judging blocks count. `choosing_runs` are the records that choose, for
    simulations. `notes` say how the rows were divided.
    """

    train: RegressionData
    choosing: RegressionData
    judging: RegressionData
    members: tuple[ConditionedRecord, ...]
    choosing_runs: tuple[Run, ...]
    divided: frozenset[Group] = frozenset()
    notes: tuple[str, ...] = ()

    @property
    def filtering(self) -> Filtering:
        """The filters of the training rows, weights by speed and sines taken out among them."""
        return self.train.records[0].filtering


def set_aside(
    train: RegressionData, data: RegressionData, members: Sequence[ConditionedRecord],
    runs: Sequence[Run],
) -> TraceRows:  # fmt: skip
    """Divide the rows `data` of held-out `runs` into choosing and judging rows.

    A group is not divided where an equation of it would have fewer than `TRACE.least_rows` on
    either side: all its rows then choose and judge.
    """
    judge = np.zeros(data.base.shape[0], dtype=bool)
    short = set()
    for s in data.segments:
        judge[s.where] = in_block = in_judging_block(data.source(s)[1].time)
        if min(in_block.sum(), (~in_block).sum()) < TRACE.least_rows:
            short.add(s.group)
    choose = ~judge
    for s in data.segments:
        if s.group in short:
            judge[s.where] = choose[s.where] = True
    divided = frozenset(conditioned.group for conditioned in data.records) - short
    return TraceRows(
        train, data.at(choose), data.at(judge), tuple(members), _without_blocks(runs, divided),
        divided, (_division_note(divided, sorted({step for _, step in short})),),
    )  # fmt: skip


def _without_blocks(runs: Sequence[Run], divided: Collection[Group]) -> tuple[Run, ...]:
    """Return the runs with NaN at the samples that are set aside in `divided` groups."""
    out = []
    for number, run in enumerate(runs):
        records = []
        for record in run.records:
            aside = in_judging_block(np.asarray(record.time)) & ((number, record.step) in divided)
            channels = {name: np.where(aside, np.nan, x) for name, x in record.channels.items()}
            records.append(replace(record, channels=channels) if aside.any() else record)
        out.append(replace(run, records=tuple(records)))
    return tuple(out)


def _division_note(divided: Collection[Group], short: Sequence[str]) -> str:
    """Return a note on which rows judge where no records were given for it."""
    if not divided:
        return (
            "the held-out records are too short to set rows aside: the same rows choose and "
            "judge; `--judge RUN` gives others to judge"
        )
    rest = f"; too short for that, {' '.join(short)} does both" if short else ""
    return (
        f"a third of the held-out rows (every third block of {DATA.judging_block:g} s) judges and "
        f"the rest chooses; `bramah trace --judge RUN` gives both in full{rest}"
    )


def refuse_repeated_records(
    runs: Sequence[Run], holdout: Sequence[Run], judge: Sequence[Run]
) -> None:
    """Raise InputError where no held-out records are given or one record serves two purposes."""
    if not holdout or not any(run.records for run in holdout):
        raise InputError(
            "no held-out records: give --holdout a run that is not used for the fit, with another "
            "excitation (other wave or amplitude)"
        )
    if judge and not any(run.records for run in judge):
        raise InputError("no judging records: the runs of --judge are empty")
    known: dict[str, str] = {}
    for kind, option, checked in (
        ("training", "", runs), ("held-out", "--holdout", holdout), ("judging", "--judge", judge),
    ):  # fmt: skip
        digests = [
            (samples_digest(record), record.name) for run in checked for record in run.records
        ]
        for digest, name in digests if option else ():
            if digest in known:
                raise InputError(
                    f"{kind} record {name!r} is {known[digest]}, sample for sample; it must not be "
                    f"used twice: give {option} other records"
                )
        known |= {digest: f"{kind} record {name!r}" for digest, name in digests}
