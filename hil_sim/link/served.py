"""A device served in a thread of this process, behind a link with changeable faults."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final, Self, TypeVar

from hil_sim.device.device import Device
from hil_sim.device.lifetime import EndpointError, WireEnd, serve_session
from hil_sim.device.server import CAN, RTU, SERIAL, SLCAN, TCP, open_wire, serve_tcp
from hil_sim.link.wires import faulty_link
from rig.model.parts import LOCALHOST

Answer = TypeVar("Answer")
SERVED: Final = (TCP, RTU, SERIAL, CAN, SLCAN)  # wires with a device and a faulty link here
_SECONDS: Final = 60.0  # [s] longer than any call here; a hang ends in an error


class ServedDevice:
    """A device behind a wire, for tests that inspect the device while a host drives it.

    `link.endpoint` is the host's endpoint; `inside` makes a call while the device rests. A context
    manager that ends both. Raises EndpointError for a wire other than those of `SERVED`.
    """

    def __init__(
        self,
        device: Device,
        wire: str,
        *,
        seed: int = 0,
        seconds: Callable[[], float] | None = None,
    ) -> None:
        if wire not in SERVED:
            raise EndpointError(f"no faults for wire {wire}; expected one of: {' '.join(SERVED)}")
        self.device = device
        self._lock = threading.Lock()
        self._ended: list[bool] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: WireEnd[Any] | None = None
        self._endpoint: Future[str] = Future()
        self._thread = threading.Thread(target=self._serve_or_report, args=(wire,), daemon=True)
        self._thread.start()
        target = self._endpoint.result(_SECONDS)
        self.link = faulty_link(target, (), seed=seed, seconds=seconds)

    @property
    def deserted(self) -> bool:
        """Whether no program has the bus open; a node detects this by its watchdog only."""
        return not getattr(self._end, "attended", True)

    def inside(self, call: Callable[[], Answer]) -> Answer:
        """Make a call between the device's actions for its host."""
        loop = self._loop
        if loop is None:
            with self._lock:
                return call()
        result: Future[Answer] = Future()

        def make_call() -> None:
            try:
                result.set_result(call())
            except BaseException as error:
                result.set_exception(error)

        loop.call_soon_threadsafe(make_call)
        return result.result(_SECONDS)

    def close(self) -> None:
        """End link, server and thread."""
        self.link.close()
        self._ended.append(True)
        self._thread.join(_SECONDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve_or_report(self, wire: str) -> None:
        try:
            if wire == TCP:
                asyncio.run(self._serve())
                return
            endpoint, self._end, session = open_wire(self.device, wire)
            self._endpoint.set_result(endpoint)
            serve_session(self._end, session, self.device, self._ended, lock=self._lock)
        except Exception as error:
            if self._endpoint.done():
                raise
            self._endpoint.set_exception(error)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        await serve_tcp(self.device, LOCALHOST, 0, self._endpoint.set_result, self._ended)
