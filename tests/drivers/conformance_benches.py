"""Subjects of the conformance checks: the integrator behind each wire, its clock in our hands."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar
from unittest.mock import patch

from drivers import message_stream, modbus_tcp
from drivers.can_stream import CanStreamDriver
from drivers.conformance import HEALTHY, Bench, Capabilities, Subject
from drivers.modbus_rtu import ModbusRtuDriver
from drivers.modbus_tcp import ModbusTcpDriver
from drivers.serial_stream import SerialStreamDriver
from hil_sim.device.can.adapters import SocketcandServer
from hil_sim.device.can.server import layout_of, run_device
from hil_sim.device.device import Device
from hil_sim.device.pty_line import PtyLine
from hil_sim.device.rtu_server import serve_line
from hil_sim.device.serial_server import serve_port
from hil_sim.device.server import serve_until
from rig.model import channels as ch
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire.can_frames import CanFrame
from tests.drivers.wires import BadLine, BadWire
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

TIMEOUT = 0.5
STEP = 0.09  # [s] of the device's clock between two polls: less than what it takes for a stall
Answer = TypeVar("Answer")


class Clocked:
    """The integrator's device, whose clock stands still but for `silence`.

    So no busy computer trips its watchdog. `at` is its endpoint; `inside` makes a call in the
    device's own thread.
    """

    def __init__(self) -> None:
        self.rig = seed_rig()
        self.now = 100.0
        self.plant = IntegratorPlant(self.rig)
        self.device = Device(self.rig, self.plant, realtime=False, clock=lambda: self.now)
        self.at = ""

    def inside(self, call: Callable[[], Answer]) -> Answer:
        """Make a call in the device's own thread."""
        raise NotImplementedError

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


class Served(Clocked):
    """The device behind Modbus, in a thread of its own."""

    def __init__(self, wire: str) -> None:
        super().__init__()
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

    def close(self) -> None:
        """End the server and its thread."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(60)


class Ended(Clocked):
    """The device behind an adapter or a line, whose answers `spoil` tampers with.

    It stands between the device and its end of the wire: what the device's server calls, it passes
    on. Faults strike the piece in the middle of what is sent next: a frame of a bus, a byte.
    """

    FAULTS = ("lose one", "late", "flip", "twice", "swap", "noise", "silent")

    def __init__(self, end: Any, serve: Callable[[Any, Device, list[int]], object]) -> None:
        super().__init__()
        self._end = end
        self._fault = HEALTHY
        self._held: Any = None
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._ended: list[int] = []
        self._thread = threading.Thread(
            target=serve, args=(self, self.device, self._ended), daemon=True
        )
        self._thread.start()

    def inside(self, call: Callable[[], Answer]) -> Answer:
        """Make a call in the device's own thread."""
        done: Future[Answer] = Future()

        def work() -> None:
            try:
                done.set_result(call())
            except BaseException as error:
                done.set_exception(error)

        self._calls.put(work)
        return done.result(60)

    def spoil(self, fault: str) -> None:
        """Tamper with what is sent from now on."""

        def begin() -> None:
            self._fault, self._held = fault, None

        self.inside(begin)

    def close(self) -> None:
        """End the server and its thread."""
        self._ended.append(1)
        self._thread.join(60)
        self._end.close()

    # -- what the device's server calls -----------------------------------------------------

    @property
    def free(self) -> bool:
        """Whether somebody listens."""
        return bool(self._end.free)

    def receive(self, patience: float) -> Any:
        """Return what has come."""
        while not self._calls.empty():
            self._calls.get()()
        return self._end.receive(min(patience, 0.003))

    def send(self, pieces: Any) -> None:
        """Send what the fault leaves of it."""
        if not len(pieces):
            return
        fault = self._fault
        if fault == "silent":
            return
        if self._held is not None:
            pieces, self._held = pieces + self._held, None
        if fault != HEALTHY:
            self._fault = HEALTHY
            pieces = self._spoiled(fault, pieces)
        self._end.send(pieces)

    def _spoiled(self, fault: str, pieces: Any) -> Any:
        k = len(pieces) // 2
        before, piece, after = pieces[:k], pieces[k : k + 1], pieces[k + 1 :]
        if fault == "late":
            self._held = piece
        return {
            "lose one": before + after,
            "late": before + after,
            "flip": before + _flipped(piece) + after,
            "twice": before + piece + piece + after,
            "swap": before + after[:1] + piece + after[1:],
            "noise": _noise(pieces) + pieces,
        }[fault]


def _flipped(piece: Any) -> Any:
    if isinstance(piece, bytes):
        return bytes([piece[0] ^ 4])
    (frame,) = piece
    return [replace(frame, data=bytes([frame.data[0] ^ 4]) + frame.data[1:])]


def _noise(pieces: Any) -> Any:
    if isinstance(pieces, bytes):
        return b"\x55\xaa\x00" * 20
    return [CanFrame(0x7E0, b"\1\2\3"), CanFrame(pieces[0].identifier, b"")]


def _reached(rig: Rig, kind: str, settings: dict[str, Any]) -> Wire:
    short = Wire(kind=kind, timeout=TIMEOUT, watchdog=rig.wire.watchdog)
    return short.reached_by(kind, settings)


@contextmanager
def _impatient() -> Iterator[None]:
    """Let a virtual device's answers be lost as soon as a real one's."""
    with (
        patch.object(modbus_tcp, "VIRTUAL_PATIENCE", 1.0),
        patch.object(message_stream, "VIRTUAL_PATIENCE", 1.0),
    ):
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


@contextmanager
def _serial() -> Iterator[Bench]:
    line = PtyLine()
    served = Ended(line, partial(serve_port, owner=None))

    def driver(rig: Rig) -> Any:
        return SerialStreamDriver(_reached(rig, "serial", {"device": line.name}), rig)

    try:
        with _impatient():
            yield Bench(
                served.rig,
                driver,
                outputs=served.outputs,
                silence=served.silence,
                spoil=served.spoil,
                faults=Ended.FAULTS,
                lost=("silent",),
                saturate=served.saturate,
            )
    finally:
        served.close()


@contextmanager
def _can() -> Iterator[Bench]:
    server = SocketcandServer("127.0.0.1", 0)

    def serve(end: Any, device: Device, ended: list[int]) -> None:
        run_device(end, device, layout_of(device.rig), ended)

    served = Ended(server, serve)
    bus = server.endpoint.removeprefix("can://")

    def cut() -> None:
        # A node of a bus does not see a program end: its watchdog does.
        served.inside(lambda: [server._drop(client) for client in list(server._clients)])
        served.silence()

    def driver(rig: Rig) -> Any:
        return CanStreamDriver(_reached(rig, "can", {"bus": bus}), rig)

    try:
        with _impatient():
            yield Bench(
                served.rig,
                driver,
                outputs=served.outputs,
                cut=cut,
                silence=served.silence,
                spoil=served.spoil,
                faults=Ended.FAULTS,
                lost=("silent",),
                saturate=served.saturate,
            )
    finally:
        served.close()


MODBUS_TCP = Subject("modbus-tcp", _tcp, Capabilities())
MODBUS_RTU = Subject("modbus-rtu", _rtu, Capabilities())
SERIAL = Subject("serial", _serial, Capabilities())
CAN = Subject("can", _can, Capabilities())
assert HEALTHY == "pass"  # as BadWire and BadLine call it
