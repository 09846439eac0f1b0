"""A study's work on processes or a cluster; what is found is kept, and a study ended goes on."""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from analysis.workers.cluster import DaskCluster
from protocols.engine.states import ProtocolAborted
from rig.model.parse import InputError

Job = TypeVar("Job")
Result = TypeVar("Result")
Workers = int | str  # processes of this machine, or tcp://HOST:PORT of a Dask scheduler
# A simulated plant that leaves its limits, or a protocol that it cannot run.
NO_RESULT: Final = (InputError, RuntimeError, ProtocolAborted)


@dataclass(frozen=True)
class Kept(Generic[Job, Result]):
    """Results as JSON files of a folder: a job's file name, a result as plain data and back."""

    folder: Path
    name: Callable[[Job], str]
    dump: Callable[[Result], Any]
    load: Callable[[Job, Any], Result]

    def __contains__(self, job: Job) -> bool:
        return (self.folder / self.name(job)).is_file()

    def read(self, job: Job) -> Result:
        """Return what was found before; raises OSError where nothing was."""
        return self.load(job, json.loads((self.folder / self.name(job)).read_text("utf-8")))

    def write(self, job: Job, found: Result) -> None:
        """Keep a result."""
        text = json.dumps(self.dump(found))
        (self.folder / self.name(job)).write_text(text, encoding="utf-8")


def performed(
    work: Sequence[Job],
    perform: Callable[[Job], Result],
    workers: Workers,
    report: Callable[[int, int, Job, Result | Exception], None],
    kept: Kept[Job, Result] | None = None,
) -> Iterator[tuple[Job, Result]]:
    """Perform jobs on `workers`; returns each with its result, in the order they end.

    What was kept comes first and is not done again. `report` receives how many jobs of how many
    are done, the job, and its result or its error. A job with an error of `NO_RESULT` is left out;
    any other error is a defect: the remaining jobs are done, then RuntimeError lists such errors.
    """
    if kept is not None:
        kept.folder.mkdir(parents=True, exist_ok=True)
    left = []
    for job in work:
        if kept is not None and job in kept:
            yield job, kept.read(job)
        else:
            left.append(job)
    defects = []
    for done, (job, found) in enumerate(_results(left, perform, workers), start=1):
        report(done, len(left), job, found)
        if isinstance(found, Exception):
            if not isinstance(found, NO_RESULT):
                defects.append(f"{job}: {type(found).__name__}: {found}")
            continue
        if kept is not None:
            kept.write(job, found)
        yield job, found
    if defects:
        raise RuntimeError(f"{len(defects)} of {len(left)} jobs failed:\n" + "\n".join(defects))


def _results(
    work: Sequence[Job], perform: Callable[[Job], Result], workers: Workers
) -> Iterator[tuple[Job, Result | Exception]]:
    """Yield jobs with what they returned or raised."""
    if isinstance(workers, str):
        with DaskCluster(workers) as pool:
            yield from zip(work, pool.map(_Caught(perform), work), strict=True)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent) as pool:
        waiting = {pool.submit(perform, job): job for job in work}
        for future in as_completed(waiting):
            try:
                found: Result | Exception = future.result()
            except BrokenExecutor:  # a RuntimeError, but of the machine and not of this job
                raise
            except Exception as error:  # the other jobs go on
                found = error
            yield waiting[future], found


@dataclass(frozen=True)
class _Caught(Generic[Job, Result]):
    """A job's work that gives back its error instead of raising it: on a cluster it ends no map."""

    perform: Callable[[Job], Result]

    def __call__(self, job: Job) -> Result | Exception:
        try:
            return self.perform(job)
        except Exception as error:  # the other jobs go on
            return error


def _end_with_parent() -> None:
    """See to it that this process does not outlive a study that was killed."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
