"""Subjects of the conformance checks: the integrator behind Modbus, its clock in our hands."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any, TypeVar
from unittest.mock import patch

from drivers import modbus_tcp
from drivers.conformance import HEALTHY, Bench, Capabilities, Subject
from drivers.modbus_rtu import ModbusRtuDriver
from drivers.modbus_tcp import ModbusTcpDriver
from hil_sim.device.device import Device
from hil_sim.device.rtu_server import serve_line
from hil_sim.device.server import serve_until
from rig.model import channels as ch
from rig.model.parts import Wire
from rig.model.rig import Rig
from tests.drivers.wires import BadLine, BadWire
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

TIMEOUT = 0.5
STEP = 0.09  # [s] of the device's clock between two polls: less than what it takes for a stall
Answer = TypeVar("Answer")


class Served:
    """The integrator's device in a thread of its own; `at` is its endpoint.

    Its clock stands still but for `pass_time`, so that no busy computer trips its watchdog.
    """

    def __init__(self, wire: str) -> None:
        self.rig = seed_rig()
        self.now = 100.0
        self.plant = IntegratorPlant(self.rig)
        self.device = Device(self.rig, self.plant, realtime=False, clock=lambda: self.now)
        self.at = ""
        self._ready = threading.Event()
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(wire),), daemon=True)
        self._thread.start()
        assert self._ready.wait(60)

    async def _serve(self, wire: str) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()

        def ready(endpoint: str) -> None:
            self.at = endpoint
            self._ready.set()

        if wire == "modbus-rtu":
            await serve_line(self._stop, self.device, on_ready=ready)
        else:
            await serve_until(self._stop, self.device, host="127.0.0.1", port=0, on_ready=ready)

    def inside(self, call: Callable[[], Answer]) -> Answer:
        """Make a call in the device's own thread."""
        done: Future[Answer] = Future()

        def work() -> None:
            try:
                done.set_result(call())
            except BaseException as error:
                done.set_exception(error)

        self._loop.call_soon_threadsafe(work)
        return done.result(60)

    def outputs(self) -> list[float]:
        """Return the outputs [V] after one more block of the device's clock."""
        device = self.device

        def run() -> list[float]:
            device._run(device.queue.room)
            return list(self.plant.volts)

        return self.inside(run)

    def silence(self) -> None:
        """Let 11 s of the device's clock pass."""

        def wait() -> None:
            for _ in range(round(11.0 / STEP)):
                self.now += STEP
                self.device.poll()

        self.inside(wait)

    def saturate(self) -> int:
        """Move the first piston beyond its sensor."""
        self.plant.piston[0] = 1.0
        return self.rig.channels.index(f"{ch.PISTON}_1")

    def close(self) -> None:
        """End the server and its thread."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(60)


def _reached(rig: Rig, kind: str, settings: dict[str, Any]) -> Wire:
    short = Wire(kind=kind, timeout=TIMEOUT, watchdog=rig.wire.watchdog)
    return short.reached_by(kind, settings)


@contextmanager
def _impatient() -> Iterator[None]:
    """Let a virtual device's answers be lost as soon as a real one's."""
    with patch.object(modbus_tcp, "VIRTUAL_PATIENCE", 1.0):
        yield


@contextmanager
def _tcp() -> Iterator[Bench]:
    served = Served("modbus-tcp")
    wire = BadWire(int(served.at.rsplit(":", 1)[1]))

    def cut() -> None:
        for end in wire._sockets:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def spoil(fault: str) -> None:
        wire.fault = fault

    def driver(rig: Rig) -> Any:
        return ModbusTcpDriver(_reached(rig, "modbus-tcp", {"port": wire.port}), rig)

    try:
        with _impatient():
            yield Bench(
                served.rig,
                driver,
                outputs=served.outputs,
                cut=cut,
                silence=served.silence,
                spoil=spoil,
                faults=("lose one", "garbage", "close", "short", "fewer", "miscounted", "silent"),
                lost=("silent", "close"),
                saturate=served.saturate,
            )
    finally:
        wire.close()
        served.close()


@contextmanager
def _rtu() -> Iterator[Bench]:
    served = Served("modbus-rtu")
    line = BadLine(served.at.removeprefix("modbus-rtu://"))

    def spoil(fault: str) -> None:
        line.fault = fault

    def driver(rig: Rig) -> Any:
        return ModbusRtuDriver(_reached(rig, "modbus-rtu", {"device": line.path}), rig)

    try:
        with _impatient():
            yield Bench(
                served.rig,
                driver,
                outputs=served.outputs,
                silence=served.silence,
                spoil=spoil,
                faults=("lose one", "late", "flip", "split", "twice", "silent"),
                lost=("silent",),
                saturate=served.saturate,
            )
    finally:
        line.close()
        served.close()


MODBUS_TCP = Subject("modbus-tcp", _tcp, Capabilities())
MODBUS_RTU = Subject("modbus-rtu", _rtu, Capabilities())
assert HEALTHY == "pass"  # as BadWire and BadLine call it
