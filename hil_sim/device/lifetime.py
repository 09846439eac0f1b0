"""The lifetime of a simulated bench, common to its servers on all wires."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from types import FrameType
from typing import Protocol, TypeVar

from hil_sim.device.device import Device

logger = logging.getLogger(__name__)

Data = TypeVar("Data")  # what a wire carries: bytes, or frames of a bus


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
    """The process that a server belongs to and ends with.

    Made before the endpoint is announced: who reads it may end at once, and until it is waited
    for, an ended process still has its number.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._child = os.getppid() == pid

    def has_ended(self) -> bool:
        """Whether the process has ended."""
        # A child's parent id is safe from a reused process number.
        ended = os.getppid() != self._pid if self._child else not _exists(self._pid)
        if ended:
            logger.info("process %d, which this server served, has ended", self._pid)
        return ended


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def while_served(ended: Sequence[object], parent: ParentProcess | None) -> Iterator[None]:
    """Yield until `ended` is not empty, or process `parent` has ended."""
    while not ended:
        yield
        if parent is not None and parent.has_ended():
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


class WireEnd(Protocol[Data]):
    """The device's end of a line, or of a bus behind an adapter."""

    @property
    def free(self) -> bool:
        """Whether a host listens and everything has been sent."""

    def receive(self, timeout: float) -> Data | None:
        """Return what arrives within `timeout` [s]; None when the host has closed the line."""

    def send(self, data: Data, /) -> None:
        """Send, or buffer what cannot be sent now."""

    def close(self) -> None:
        """End the wire."""


class WireSession(Protocol[Data]):
    """A host's requests to a device, in the form of one wire."""

    def receive(self, data: Data, /) -> Data:
        """Execute the requests that `data` completes; return the answers."""

    def push(self) -> Data:
        """Return the next block if it may be sent without a request, else nothing."""

    def ended(self) -> None:
        """Handle the end of the connection: no program has the other end of the line open."""


def serve_session(
    end: WireEnd[Data],
    session: WireSession[Data],
    device: Device,
    ended: Sequence[object],
    parent: ParentProcess | None = None,
    lock: AbstractContextManager[object] | None = None,
) -> None:
    """Serve a device until `ended` is not empty, or process `parent` has ended; close `end`.

    `lock` is held except while waiting for the host, for other users of the device.
    """
    lock = lock or nullcontext()
    try:
        for _ in while_served(ended, parent):
            received = end.receive(device.idle_seconds())
            with lock:
                if received is None:
                    session.ended()
                elif received:
                    end.send(session.receive(received))
                device.poll()
                while end.free and (block := session.push()):
                    end.send(block)
    finally:
        device.zero()
        end.close()
