"""A link between a host and a device that applies faults to their frames.

One thread serves both directions. Each kind of wire has a class with its sockets or terminals
(`hil_sim.link.tcp`, `hil_sim.link.line`; `hil_sim.link.wires` lists them).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import ClassVar, Final, Self

from hil_sim.faults.wire import TO_DEVICE, TO_HOST, Carrier, WireFault
from hil_sim.link.frames import Framing
from hil_sim.link.way import FaultInjector, Way

logger = logging.getLogger(__name__)

LONGEST_WAIT: Final = 0.05  # [s] of one wait for bytes: longest delay of another thread's request
_END_SECONDS: Final = 5.0


class FaultyLink(ABC):
    """A link in a thread of its own; a context manager that ends it.

    `seconds` is the device's time, by which faults begin and end; without it, the time since the
    link was made. `seed` draws which frames a fault changes, for each way by itself.
    """

    endpoint: str  # the host's of this link
    carrier: ClassVar[Carrier] = Carrier.LINE  # what carries it, but for a wire with its own

    def __init__(
        self,
        target: str,
        framing: Framing,
        faults: Sequence[WireFault],
        seed: int,
        seconds: Callable[[], float] | None,
        port: int,
    ) -> None:
        self._framing = framing
        self._injectors = (
            FaultInjector(TO_DEVICE, faults, (seed, 0), framing.carrier or self.carrier),
            FaultInjector(TO_HOST, faults, (seed, 1), framing.carrier or self.carrier),
        )
        created = time.monotonic()
        self.seconds = seconds or (lambda: time.monotonic() - created)
        self._closing = False
        self._cut = False
        self._open(target, port)
        self._thread = threading.Thread(target=self._run, name="faulty link", daemon=True)
        self._thread.start()

    @abstractmethod
    def _open(self, target: str, port: int) -> None:
        """Make the host's end of a link to the device at `target`, and `endpoint`."""

    @abstractmethod
    def _step(self) -> None:
        """Transfer pending bytes, waiting at most `LONGEST_WAIT` for them."""

    @abstractmethod
    def _hang_up(self) -> None:
        """End every connection of both sides."""

    @abstractmethod
    def _end(self) -> None:
        """Release the link's resources."""

    @property
    def injected(self) -> Counter[str]:
        """The number of frames changed by each fault."""
        first, second = self._injectors
        return first.counts + second.counts

    def use(self, faults: Sequence[WireFault]) -> None:
        """Replace the faults from now on; without any the link is healthy."""
        for injector in self._injectors:
            injector.use(faults)

    def cut(self) -> None:
        """End every connection, as the death of the host's process does."""
        self._cut = True
        deadline = time.monotonic() + _END_SECONDS
        while self._cut and time.monotonic() < deadline:
            time.sleep(LONGEST_WAIT / 50)

    def close(self) -> None:
        """End the link and its thread."""
        self._closing = True
        self._thread.join(_END_SECONDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ways(self) -> tuple[Way, Way]:
        """Return the directions of a new connection: to the device, to the host."""
        to_device, to_host = self._injectors
        framing = self._framing
        on_wire = framing.on_wire
        return (
            Way(to_device, framing.to_device, on_wire),
            Way(to_host, framing.to_host, on_wire, framing.error_of),
        )

    def _longest_wait(self, ways: Sequence[Way], now: float) -> float:
        """Return how long [s] the link may wait for bytes before a piece is due."""
        due = min((way.next_time() for way in ways), default=math.inf)
        return min(max(due - now, 0.0), LONGEST_WAIT)

    def _run(self) -> None:
        try:
            while not self._closing:
                if self._cut:
                    self._hang_up()
                    self._cut = False
                self._step()
        except OSError:
            logger.exception("the link has failed")
        finally:
            self._hang_up()
            self._end()
