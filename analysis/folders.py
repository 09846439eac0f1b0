"""Identification from run folders that need not fit into memory, here or where the folders are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from analysis import checks as ck
from analysis.compute import Pool, Serial
from analysis.condense import Task, first_of_steps, moving_task, path_of, reduce_task, steps_of
from analysis.identify import Identification, conclude
from analysis.rows import Filtering, default_filtering
from analysis.terms import with_effects
from analysis.terms.base import Used
from rig.model.records import Record
from rig.services.stream import read_run_head


def identify_folders(
    folders: Sequence[str],
    terms: Sequence[Used] | None = None,
    filtering: Callable[[Record], Filtering] = default_filtering,
    reject_noise: bool = True,
    pool: Pool | None = None,
    effects: Sequence[str] = (),
) -> Identification:
    """Identify from run folders, of which one record at a time is in memory.

    This is `identify` by the coupled method with the estimator "plain", for the other methods and
    estimators go over all rows again and again. `terms` defaults to the rig's baseline with
    `effects` (`analysis.terms.with_effects`). With a `pool` each record is reduced in one of its
    processes, where the folders are read; only triangles come back. Raises InputError as
    `identify` and `load_run` do.
    """
    workers = pool or Serial()
    heads = list(workers.map(read_run_head, folders, reads=str))
    rig = ck.common_rig(heads)
    used = tuple(terms) if terms is not None else tuple(map(Used, with_effects(rig, effects)))
    steps = [
        (number, one)
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True))
        for one in steps_of(rig, folder, head.records)
    ]
    found = workers.map(moving_task, [one for _, one in steps], reads=path_of)
    moving = {(n, one.step): moves for (n, one), moves in zip(steps, found, strict=True)}
    tasks = [
        Task(
            rig,
            number,
            folder,
            record.name,
            used,
            filtering,
            record.name in first,
            moving=moving.get((number, record.step)),
        )
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True))
        for first in (first_of_steps(head.records),)
        for record in head.records
    ]
    reductions = list(workers.map(reduce_task, tasks, reads=path_of))
    return conclude(rig, [h.source for h in heads], used, reductions, reject_noise)
