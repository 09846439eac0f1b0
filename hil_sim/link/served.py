"""A device served in a thread of this process, behind a link with changeable faults."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Final, Self, TypeVar

from hil_sim.device.device import Device
from hil_sim.device.lifetime import EndpointError
from hil_sim.device.pty_line import PtyLine
from hil_sim.device.rtu_server import serve_line
from hil_sim.device.serial_server import serve_port
from hil_sim.device.server import BITRATE, CAN, RTU, SERIAL, SLCAN, TCP, serve_until
from hil_sim.link.wires import faulty_link

if TYPE_CHECKING:
    from hil_sim.device.can.adapters import Adapter

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
        self._adapter: Adapter | None = None
        self._endpoint: Future[str] = Future()
        self._thread = threading.Thread(target=self._serve_or_report, args=(wire,), daemon=True)
        self._thread.start()
        target = self._endpoint.result(_SECONDS)
        self.link = faulty_link(target, (), seed=seed, seconds=seconds)

    @property
    def deserted(self) -> bool:
        """Whether no program has the bus open; a node detects this by its watchdog only."""
        return self._adapter is not None and not self._adapter.attended

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
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(_SECONDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve_or_report(self, wire: str) -> None:
        try:
            if wire == SERIAL:
                self._serve_port()
            elif wire in (CAN, SLCAN):
                self._serve_bus(wire)
            else:
                asyncio.run(self._serve(wire))
        except Exception as error:
            if self._endpoint.done():
                raise
            self._endpoint.set_exception(error)

    def _serve_port(self) -> None:
        line = PtyLine()
        self._endpoint.set_result(f"{SERIAL}://{line.name}")
        try:
            serve_port(line, self.device, self._ended, lock=self._lock)
        finally:
            self.device.zero()
            line.close()

    def _serve_bus(self, wire: str) -> None:
        # Half a second of imports that no other wire needs.
        from hil_sim.device.can import adapters, server  # noqa: PLC0415

        adapter = (
            adapters.SlcanLine(BITRATE)
            if wire == SLCAN
            else adapters.SocketcandServer("127.0.0.1", 0)
        )
        layout = server.layout_of(self.device.rig)
        self._adapter = adapter
        self._endpoint.set_result(adapter.endpoint)
        try:
            server.run_device(adapter, self.device, layout, self._ended, lock=self._lock)
        finally:
            self.device.zero()
            adapter.close()

    async def _serve(self, wire: str) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        ready = self._endpoint.set_result
        if wire == RTU:
            await serve_line(self._stop, self.device, on_ready=ready)
        else:
            await serve_until(self._stop, self.device, host="127.0.0.1", port=0, on_ready=ready)
