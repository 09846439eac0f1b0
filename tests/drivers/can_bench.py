"""The subject of the conformance checks on a CAN bus: frames are tampered with at the adapter."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from queue import SimpleQueue
from typing import Any, TypeVar
from unittest.mock import patch

from drivers import message_stream
from drivers.can_stream import CanStreamDriver
from drivers.conformance import HEALTHY, Capabilities, DeviceUnderTest, Subject
from hil_sim.device.can.adapters import SocketcandServer
from hil_sim.device.can.server import CanSession
from hil_sim.device.device import Device
from hil_sim.device.lifetime import serve_session
from rig.model import channels as ch
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire.can_frames import CanFrame
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

TIMEOUT = 0.5
LOST = ("silent",)
STEP = 0.09  # [s] of the device's clock between two polls: less than what it takes for a stall
Answer = TypeVar("Answer")


class SpoiledAdapter:
    """An adapter of a simulated bus that tampers with what the device sends.

    It stands between the device's server and the adapter `end`: what the server calls, it passes
    on. A fault strikes the frame in the middle of what is sent next.
    """

    FAULTS = ("lose one", "late", "flip", "twice", "swap", "noise", "silent")

    def __init__(self, end: Any) -> None:
        self._end = end
        self._fault = HEALTHY
        self._held: Any = None
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()

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

    # -- what the device's server calls -----------------------------------------------------

    @property
    def endpoint(self) -> str:
        """Where a program reaches the bus."""
        return str(self._end.endpoint)

    @property
    def attended(self) -> bool:
        """Whether a program has the bus open."""
        return bool(self._end.attended)

    @property
    def free(self) -> bool:
        """Whether somebody listens."""
        return bool(self._end.free)

    def receive(self, timeout: float) -> Any:
        """Return what has come."""
        while not self._calls.empty():
            self._calls.get()()
        return self._end.receive(min(timeout, 0.003))

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

    def close(self) -> None:
        """End the adapter."""
        self._end.close()

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


class CanDevice(SpoiledAdapter):
    """The integrator's device behind an adapter whose frames `spoil` tampers with.

    Its clock stands still but for `silence`, so that no busy computer trips its watchdog.
    """

    def __init__(
        self,
        end: Any,
        serve: Callable[[Any, Device, list[int]], object],
        alone: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(end)
        self._alone = alone  # nobody is there whom a stalled computer could keep from speaking
        self.rig = seed_rig()
        self.now = 100.0
        self.plant = IntegratorPlant(self.rig)
        self.device = Device(self.rig, self.plant, realtime=False, clock=lambda: self.now)
        self._ended: list[int] = []
        self._thread = threading.Thread(
            target=serve, args=(self, self.device, self._ended), daemon=True
        )
        self._thread.start()

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

    def receive(self, timeout: float) -> Any:
        """Return what has come; time passes where nobody is there."""
        if self._alone():
            self.now += STEP
        return super().receive(timeout)

    def end(self) -> None:
        """End the server, which closes its adapter, and its thread."""
        self._ended.append(1)
        self._thread.join(60)


def drop_all(server: SocketcandServer) -> None:
    """End every link of a bus server without a goodbye."""
    for client in list(server._clients):
        server._drop(client)


def _flipped(frames: list[CanFrame]) -> list[CanFrame]:
    (frame,) = frames
    return [replace(frame, data=bytes([frame.data[0] ^ 4]) + frame.data[1:])]


def _noise(frames: list[CanFrame]) -> list[CanFrame]:
    return [CanFrame(0x7E0, b"\1\2\3"), CanFrame(frames[0].identifier, b"")]


def _can(faults: tuple[str, ...]) -> Iterator[DeviceUnderTest]:
    server = SocketcandServer("127.0.0.1", 0)

    def serve(end: Any, device: Device, ended: list[int]) -> None:
        serve_session(end, CanSession(device), device, ended)

    # A program that left without a goodbye is gone for the watchdog only.
    served = CanDevice(server, serve, lambda: not server._clients)
    bus = server.endpoint.removeprefix("can://")

    def cut() -> None:
        # A node of a bus does not see a program end: its watchdog does.
        served.inside(lambda: drop_all(server))
        served.silence()

    def driver(rig: Rig) -> Any:
        quick = Wire(kind="can", timeout=TIMEOUT, watchdog=rig.wire.watchdog)
        return CanStreamDriver(quick.reached_by("can", {"bus": bus}), rig)

    try:
        # Let a virtual device's answers be lost as soon as a real one's.
        with patch.object(message_stream, "VIRTUAL_TIMEOUT_FACTOR", 1.0):
            yield DeviceUnderTest(
                served.rig,
                driver,
                outputs=served.outputs,
                cut=cut,
                silence=served.silence,
                spoil=served.spoil,
                faults=faults,
                lost=LOST,
                saturate=served.saturate,
            )
    finally:
        served.end()


def can_subject(names: Sequence[str] = CanDevice.FAULTS) -> Subject:
    """The driver of a CAN bus whose frames these faults strike, by default all."""
    make: Callable[[], Any] = contextmanager(lambda: _can(tuple(names)))
    return Subject("can", make, Capabilities())
