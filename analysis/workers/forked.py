"""Copies of this process that share the work: for closures over data too large to transfer."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, get_context
from typing import Any, Final, Self, TypeVar

from analysis.workers.pool import Reads

log = logging.getLogger(__name__)

T = TypeVar("T")
U = TypeVar("U")

MOST_WORKERS: Final = 8  # each may fill caches of its own


def usable_cores() -> int:
    """Return the number of processor cores that this process may use; 1 where it must not fork.

    Another thread may hold a lock, which stays locked in a copy. Elsewhere than on Linux libraries
    of the system do not survive a fork.
    """
    if threading.active_count() > 1 or not sys.platform.startswith("linux"):
        return 1
    return len(os.sched_getaffinity(0))


class Forked:
    """This process and copies of it, which live for one `map` each (`analysis.workers.pool.Pool`).

    A copy begins with all data of this process, so that the function may be a closure; what it
    changes is lost with it, and only its results, which must be picklable, are transferred. Items
    of a copy that dies are done again by this process. A map within a map is done by the process
    that does the outer one.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = min(MOST_WORKERS, workers or usable_cores())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(
        self, function: Callable[[T], U], items: Iterable[T], reads: Reads[T] | None = None
    ) -> Iterator[U]:
        """Yield function(item) in the items' order."""
        items = list(items)
        if min(self.workers, len(items)) < 2:
            yield from map(function, items)
            return
        workers, self.workers = self.workers, 1
        try:
            values = self._shared(function, items, workers)
        finally:
            self.workers = workers
        yield from values

    def _shared(self, function: Callable[[T], U], items: Sequence[T], workers: int) -> list[U]:
        """Return function(item) of all items, each taken by whichever process is free."""
        context: Any = get_context("fork")
        taken = context.Value("l", 0)

        def done() -> Iterator[tuple[int, U | _Failure]]:
            while True:
                with taken.get_lock():
                    number = taken.value
                    taken.value += 1
                if number >= len(items):
                    return
                try:
                    result: U | _Failure = function(items[number])
                except Exception as error:
                    result = _Failure(error)
                yield number, result
                if isinstance(result, _Failure):
                    return

        copies: list[_Copy] = []
        try:
            while len(copies) < min(workers, len(items)) - 1:
                copy = _started(context, done)
                if copy is None:
                    break
                copies.append(copy)
            out = dict(done())
            for _, receiver in copies:
                out |= _received(receiver)
        finally:
            for process, receiver in copies:
                receiver.close()
                process.kill()
                process.join()
        values: list[U] = []
        for number, item in enumerate(items):
            value = out[number] if number in out else function(item)
            if isinstance(value, _Failure):
                raise value.error
            values.append(value)
        return values


@dataclass(frozen=True)
class _Failure:
    """What a function raised for an item; of several, the first item's is raised."""

    error: Exception


_Copy = tuple[Any, connection.Connection]  # a process and what it sends at its end


def _started(context: Any, done: Callable[[], Iterator[tuple[int, Any]]]) -> _Copy | None:
    """Start a copy that sends what it has `done`; None where the system has no room for it."""
    parent = os.getpid()

    def work(sender: connection.Connection) -> None:
        gc.freeze()  # a collection would copy the pages of every object
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its copies
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        results: dict[int, Any] = {}  # sent at the end: a full pipe would stop the work
        for number, result in done():
            results[number] = result
            if os.getppid() != parent:
                return
        sender.send(results)

    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(sender,), daemon=True)
    try:
        with warnings.catch_warnings():
            # Threads of a matrix library, which prepares itself for a fork.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError as error:  # no memory for it, or too many processes
        log.warning("no further process to share the work: %s", error)
        receiver.close()
        return None
    finally:
        sender.close()
    return process, receiver


def _received(receiver: connection.Connection) -> dict[int, Any]:
    """Return the numbered results of a copy, none if it died."""
    try:
        received: dict[int, Any] = receiver.recv()
    except EOFError:
        log.warning("a process that shared the work died (out of memory, or killed)")
        return {}
    return received
