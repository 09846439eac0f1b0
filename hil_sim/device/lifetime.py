"""The lifetime of a simulated bench, common to its servers on all wires."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final

logger = logging.getLogger(__name__)

PARENT_SECONDS: Final = 0.25  # between two checks of the parent


class EndpointError(Exception):
    """The bench cannot be offered at an endpoint; the message names the place and a remedy."""


def cannot_listen(host: str, port: int, error: OSError) -> EndpointError:
    """Return the error of a port that cannot be listened on."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    return EndpointError(
        f"cannot listen on {host}:{port}: {reason}; end what uses the port, "
        "or choose another one (0: any free one)"
    )


class ParentProcess:
    """The process that a server belongs to and ends with."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._child = os.getppid() == pid

    def has_ended(self) -> bool:
        """Whether the process has ended."""
        # A child's parent id is safe from a reused process number.
        return os.getppid() != self._pid if self._child else not _exists(self._pid)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def run_until(ended: Sequence[object], parent: int | None, step: Callable[[], None]) -> None:
    """Call `step` until `ended` is not empty, or process `parent` has ended."""
    parent_process = None if parent is None else ParentProcess(parent)
    next_check = time.monotonic()
    while not ended:
        step()
        if parent_process is not None and time.monotonic() > next_check:
            next_check = time.monotonic() + PARENT_SECONDS
            if parent_process.has_ended():
                logger.info("process %d, which this server served, has ended", parent)
                return


@contextmanager
def termination_signals() -> Iterator[list[int]]:
    """Collect SIGTERM and SIGINT in the list returned, instead of ending."""
    signals: list[int] = []

    def collect(number: int, _frame: FrameType | None) -> None:
        signals.append(number)

    previous = {}
    # Only a main thread has signals; elsewhere the caller ends its process.
    with suppress(ValueError):
        for number in (signal.SIGTERM, signal.SIGINT):
            previous[number] = signal.signal(number, collect)
    try:
        yield signals
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
