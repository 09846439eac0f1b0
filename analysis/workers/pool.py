"""A common interface to run work: in this process, in processes of this machine, on a cluster.

A pool maps a plain function (importable by name, picklable, no state of its own) over items and
yields the results in the items' order; exceptions of the function are raised by `map`. Use it as a
context manager: processes and connections end with it in any case.

    with Processes(workers) as pool:
        for result in pool.map(one_study, seeds): ...

Random seeds belong to the items (a seed, a `SeedSequence` child), never to the process. Items are
submitted only a little ahead of the results taken, so they may be an endless generator.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

T = TypeVar("T")
U = TypeVar("U")
Reads = Callable[[T], str]

AHEAD = (
    8  # items submitted per worker beyond the one waited for, so that a slow item delays no other
)
# Every library that multiplies matrices reads one of these when it is loaded.
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


class Pool(Protocol):
    """Maps functions over items; a context manager that ends what it started."""

    @property
    def workers(self) -> int:
        """Number of items worked on at once."""

    def map(
        self, function: Callable[[T], U], items: Iterable[T], reads: Reads[T] | None = None
    ) -> Iterator[U]:
        """Yield function(item) in the items' order.

        `reads` names the file or folder that an item needs; a pool across machines runs the item
        where that exists, the others ignore it.
        """

    def __enter__(self) -> Self:
        """Begin."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End everything that was started."""


class Serial:
    """Runs in this process: for tests, small work, and `--debug`."""

    workers = 1

    def map(
        self, function: Callable[[T], U], items: Iterable[T], reads: Reads[T] | None = None
    ) -> Iterator[U]:
        """Yield function(item), each when requested."""
        return map(function, items)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Processes:
    """Processes of this machine, started afresh (not forked), one BLAS thread each.

    Started when the `with` block begins and ended with it; a process that dies ends the map with a
    ChildProcessError. A script that uses it needs the usual ``if __name__ == "__main__":``.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = max(1, workers or os.cpu_count() or 1)
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        context = get_context("spawn")
        self._executor = ProcessPoolExecutor(self.workers, mp_context=context)
        with environment():
            for _ in range(self.workers):  # each starts one process, which keeps this environment
                self._executor.submit(_nothing)
        return self

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None

    def map(
        self, function: Callable[[T], U], items: Iterable[T], reads: Reads[T] | None = None
    ) -> Iterator[U]:
        """Yield function(item) in the items' order."""
        if self._executor is None:
            raise ValueError("use the pool in a `with` block")
        submit = self._executor.submit
        try:
            yield from in_order(lambda item: submit(function, item), items, self.workers)
        except BrokenProcessPool as error:
            raise ChildProcessError(
                "a worker process died (out of memory, or killed); its work is lost"
            ) from error


def in_order(submit: Callable[[T], Any], items: Iterable[T], workers: int) -> Iterator[Any]:
    """Submit items a little ahead and yield their futures' results in order.

    Remaining items are cancelled when the caller stops, or when one fails.
    """
    waiting: deque[Any] = deque()
    try:
        for item in items:
            waiting.append(submit(item))
            if len(waiting) > AHEAD * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def environment(changes: Mapping[str, str] = ONE_THREAD) -> Iterator[None]:
    """Change the environment that child processes inherit; by default one BLAS thread."""
    before = {key: os.environ.get(key) for key in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


def _nothing() -> None:
    pass
