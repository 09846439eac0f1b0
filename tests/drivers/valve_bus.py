"""The subject of the conformance checks of CiA 408: valves on a bus, time in the test's hands."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, Generic, Self, TypeVar

from drivers.canopen_408 import CanOpen408Driver
from drivers.conformance import Capabilities, DeviceUnderTest, Subject
from drivers.registry import wire_at
from hil_sim.device.can.adapters import SocketcandServer
from hil_sim.device.can.valve_bench import POLL_SECONDS, ValveBench
from hil_sim.plant.interface import PlantInterface
from rig.model import channels as ch
from rig.model.parts import Wire
from rig.model.rig import Rig
from tests.drivers.can_bench import SpoiledAdapter, drop_all
from tests.drivers.polled_bench import FakeClock
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

SomePlant = TypeVar("SomePlant", bound=PlantInterface)
TIMEOUT: Final = 0.3  # [s] of real time for an answer
SILENCE: Final = 11.0  # [s]
# No flipped bit: a bus node discards such a frame by its checksum, which is to lose it. The nodes
# send one frame at a time, so that a late one is also one out of its order.
LOST: Final = ("silent",)
FAULTS: Final = ("lose one", "late", "twice", "noise", "silent")


class HeldValves(Generic[SomePlant]):
    """A plant behind valves whose clock is the host's, plus what `outputs` has used.

    Its context ends the valves' thread and the bus.
    """

    def __init__(self, rig: Rig, plant: SomePlant, timeout: float = 5.0) -> None:
        self.rig = rig
        self._timeout = timeout
        self.clock = FakeClock()
        self.plant = plant
        self._server = SocketcandServer("127.0.0.1", 0)
        self.adapter = SpoiledAdapter(self._server)
        self._ahead = 0.0
        self._bench = ValveBench(self.rig, self.plant, self.adapter, self._now)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def outputs(self) -> list[float]:
        """Return the outputs [V] after one more block of the plant."""

        def run() -> list[float]:
            self._ahead += 10.0 / self.rig.sample_rate
            self._bench.poll(0.0)
            return self._bench.volts

        # Frames that were sent before this call are in the socket: taken in by the first poll.
        self.adapter.inside(lambda: self._bench.poll(0.0))
        return self.adapter.inside(run)

    def silence(self) -> None:
        """Let 11 s pass for host and valves."""
        self.clock.pass_(SILENCE)
        self.adapter.inside(lambda: self._bench.poll(0.0))

    def cut(self) -> None:
        """End the host's link; a node does not see that, its watch on the heartbeat does."""
        server = self._server
        self.adapter.inside(lambda: drop_all(server))
        self.silence()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wire(self, rig: Rig) -> Wire:
        """Return the wire that reaches the valves, its other times as the rig's."""
        wire = wire_at(self.adapter.endpoint.replace("can://", "canopen-408://", 1), rig.wire)
        return wire.model_copy(update={"timeout": self._timeout})

    def driver(self, rig: Rig) -> CanOpen408Driver:
        """Return an unconnected driver whose time is this bench's."""
        return CanOpen408Driver(self.wire(rig), rig, clock=self.clock, sleep=self.clock.sleep)

    def close(self) -> None:
        """End the valves' thread and the bus."""
        self._ended.set()
        self._thread.join(60)
        self.adapter.close()

    def _now(self) -> float:
        return self.clock() + self._ahead

    def _serve(self) -> None:
        while not self._ended.is_set():
            self._bench.poll(POLL_SECONDS)


def _valves(faults: tuple[str, ...]) -> Iterator[DeviceUnderTest]:
    rig = seed_rig()
    plant = IntegratorPlant(rig)

    def saturate() -> int:
        plant.piston[0] = 1.0
        return rig.channels.index(f"{ch.PISTON}_1")

    with HeldValves(rig, plant, TIMEOUT) as held:
        yield DeviceUnderTest(
            held.rig,
            held.driver,
            outputs=held.outputs,
            cut=held.cut,
            silence=held.silence,
            spoil=held.adapter.spoil,
            faults=faults,
            lost=LOST,
            saturate=saturate,
        )


# A valve knows neither the rig nor its sample rate; laws and samples are the host's.
CLAIMS: Final = Capabilities(host_timed=True, virtual_time=False, refuses_other_rigs=False)


def valves_subject(names: Sequence[str] = FAULTS) -> Subject:
    """The driver of valves on a bus whose frames these faults strike, by default all."""
    make: Callable[[], Any] = contextmanager(lambda: _valves(tuple(names)))
    return Subject("canopen-408", make, CLAIMS)
