"""Identification from run folders that need not fit into memory, here or where the folders are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from analysis.effects.base import open_shapes
from analysis.identify import checks as ck
from analysis.identify.coupled import conclude
from analysis.identify.geometry import shifts_of_reductions
from analysis.identify.reduction import (
    RecordReduction,
    RecordTask,
    bands_task,
    first_of_steps,
    reduce_tasks,
    steps_of,
)
from analysis.identify.result import Identification
from analysis.regression.rows import Filtering, default_filtering
from analysis.simulation.model import Model, refuse_other_rig
from analysis.terms import with_effects
from analysis.terms.base import Used
from analysis.workers.pool import Pool, Serial
from rig.model.parse import InputError
from rig.model.records import Record
from rig.model.rig import Rig
from rig.runs.stream import read_run_head

RECORDS_TOGETHER = 6  # most records given to a worker at once: progress is reported between them


def identify_folders(
    folders: Sequence[str],
    filtering: Callable[[Record], Filtering] = default_filtering,
    reject_noise: bool = True,
    pool: Pool | None = None,
    effects: Sequence[str] = (),
    like: Model | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Identify from run folders, of which one record at a time is in memory.

    This is `identify` by the coupled method with the estimator "plain", because the other methods
    and estimators need all rows repeatedly. The terms are those of the model `like`, or the rig's
    baseline with `effects` (`analysis.terms.with_effects`). The records are read once more for
    every number of the rig with a tolerance (`analysis.identify.geometry`). With a `pool` each
    record is reduced in one of its processes, where the folders are read; only triangles come back.
    `progress` receives the share of the records that are reduced, 0 to 1. Raises InputError as
    `identify` and `load_run` do, for a model of another rig, and for an effect whose shape is open.
    """
    workers = pool or Serial()
    heads = list(workers.map(read_run_head, folders, reads=str))
    rig = ck.common_rig(heads)
    used = tuple(map(Used, with_effects(rig, effects)))
    if like is not None:
        for head in heads:
            refuse_other_rig(like, head.rig, head.source)
        used = tuple(like.terms)
    _refuse_open(rig, used)
    steps = [
        (number, repeats)
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True))
        for repeats in steps_of(rig, folder, head.records)
    ]
    tasks_of_steps = [repeats for _, repeats in steps]
    decisions = workers.map(bands_task, tasks_of_steps, reads=lambda task: task.path)
    bands = {(n, repeats.step): band for (n, repeats), band in zip(steps, decisions, strict=True)}
    rigs = [rig, *map(rig.with_moved, rig.uncertain_numbers)]
    tasks = [
        RecordTask(
            changed,
            number,
            folder,
            record.name,
            used,
            filtering,
            changed is rig and record.name in first,
            bands=bands.get((number, record.step)),
        )
        for changed in rigs
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True))
        for first in (first_of_steps(head.records),)
        for record in head.records
    ]
    reductions: list[RecordReduction] = []
    groups = _groups(tasks, workers.workers)
    for group in workers.map(reduce_tasks, groups, reads=lambda part: part[0].path):
        reductions += group
        if progress is not None:
            progress(len(reductions) / len(tasks))
    count = len(tasks) // len(rigs)
    own, *moved = (reductions[k : k + count] for k in range(0, len(tasks), count))
    geometry = shifts_of_reductions(rig, used, own, moved)
    return conclude(rig, [h.source for h in heads], used, own, reject_noise, geometry=geometry)


def _groups(tasks: Sequence[RecordTask], workers: int) -> list[list[RecordTask]]:
    """Return the tasks in groups of one folder, at least four groups for each worker.

    A cluster needs some milliseconds to send an item, as much as the reduction of a short record.
    """
    most = max(1, min(RECORDS_TOGETHER, len(tasks) // (4 * workers)))
    groups: list[list[RecordTask]] = []
    for task in tasks:
        if not groups or len(groups[-1]) == most or groups[-1][0].path != task.path:
            groups.append([])
        groups[-1].append(task)
    return groups


def _refuse_open(rig: Rig, terms: Sequence[Used]) -> None:
    """Raise InputError for an effect whose shape must be searched with all rows in memory."""
    for used in terms:
        if open_shapes(rig, used):
            raise InputError(
                f"--with {used.term.name} has a shape to be found in rows that are all in memory: "
                "identify a part of the records without --stream or --cluster, write its --model, "
                "and take the shape from there with --like"
            )
