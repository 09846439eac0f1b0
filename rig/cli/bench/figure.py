"""A measured performance figure with its limit, and processor times of a piece of work."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

REPEATS: Final = 5


@dataclass(frozen=True)
class Figure:
    """One measured number and its upper limit, or its lower limit if `above`."""

    group: str
    name: str
    value: float
    unit: str = ""
    limit: float | None = None
    above: bool = False

    @property
    def ok(self) -> bool:
        """Whether the number is within its limit; True without a limit."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.above else self.value <= self.limit


@dataclass(frozen=True)
class ProcessorTime:
    """Processor time [s] of one piece of work: least and median of its repeats.

    The least is the cost of the work; a median far above it means that the machine was busy.
    """

    least: float
    median: float


def processor_time(work: Callable[[], object]) -> ProcessorTime:
    """Return the processor time of `work`, done several times."""
    (single,) = processor_times({"": work}).values()
    return single


def processor_times(
    works: dict[str, Callable[[], object]], repeats: int = REPEATS
) -> dict[str, ProcessorTime]:
    """Return the processor time of each of several pieces of work, done in turns.

    In turns, so that changes of the machine's load affect all of them alike.
    """
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            start = time.process_time()
            work()
            times[name].append(time.process_time() - start)
    return {name: ProcessorTime(min(t), float(np.median(t))) for name, t in times.items()}
