"""Runs a target's cases in a process of its own: a crash or a hang has a name and a case."""

from __future__ import annotations

import logging
import multiprocessing
import random
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from rig.cli.bench.stream import peak_memory
from tests.studies.fuzz.mutation import damaged
from tests.studies.fuzz.targets import MAKERS, Target

LONGEST = 20.0  # [s] for one case; a hang is named after that
REPORTED = 1.0  # [s] between two signs of life
_MEMORY = 400e6  # [bytes] that a process may grow by


@dataclass
class FuzzResult:
    """What the cases of one target did."""

    name: str
    cases: int = 0
    refused: int = 0
    slowest: float = 0.0  # [s]
    slowest_case: int = 0
    grown: float = 0.0  # [bytes] of the process's largest size since its first case
    wrong: Counter[str] = field(default_factory=Counter)  # errors that may not come, and how often


def cases(
    target: Target, count: int, seed: int, found: FuzzResult, report: Callable[[], None]
) -> None:
    """Read `count` damaged examples of a target; notes what may not happen in `found`."""
    before, said = peak_memory(), time.perf_counter()
    for number in range(count):
        rng = random.Random(f"{seed} {target.name} {number}")
        data = damaged(rng, rng.choice(target.examples), target.examples)
        began = time.perf_counter()
        try:
            target.read(data)
        except target.allowed:
            found.refused += 1
        except Exception as error:
            found.wrong[f"{type(error).__name__}: {error} (case {number})"[:200]] += 1
        now = time.perf_counter()
        if now - began > found.slowest:
            found.slowest, found.slowest_case = now - began, number
        found.cases += 1
        if now > said + REPORTED:
            found.grown, said = max(0.0, peak_memory() - before), now
            report()
    found.grown = max(0.0, peak_memory() - before)
    if found.grown > _MEMORY:
        found.wrong[f"grew by {found.grown / 1e6:.0f} MB"] += 1


def fuzz(key: str, count: int, seed: int) -> FuzzResult:
    """Run a target's cases in a process; a crash or a hang stands in the result by its case."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(key, count, seed, theirs), daemon=True)
    process.start()
    theirs.close()
    found, whole = FuzzResult(key), False
    try:
        while ours.poll(LONGEST * 4):  # a busy computer gets some time more
            found, whole = ours.recv()
            if whole:
                break
    except EOFError:
        process.join(5.0)
        found.wrong[f"crash ({process.exitcode}) after case {found.cases}"] += 1
    else:
        if not whole:
            found.wrong[f"hang after case {found.cases}"] += 1
    if process.is_alive():
        process.join(5.0)
        process.kill()
    return found


def _work(key: str, count: int, seed: int, pipe: Connection) -> None:
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    target = MAKERS[key]()
    found = FuzzResult(target.name)
    cases(target, count, seed, found, lambda: pipe.send((found, False)))
    pipe.send((found, True))
