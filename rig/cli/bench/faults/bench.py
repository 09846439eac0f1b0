"""A simulated bench in a separate process, with faults that the caller switches on."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final

from hil_sim.device.device import Device
from hil_sim.faults.base import Fault
from hil_sim.faults.wire import WireFault
from hil_sim.link.served import ServedDevice
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.scenario.file import Scenario
from rig.model.rig import Rig

SILENCE: Final = 2.0  # [s] without a host, after which a device in virtual time zeroes its outputs
_START_SECONDS: Final = 300.0  # [s] for the process to start, on a busy computer


@dataclass(frozen=True)
class FaultBenchState:
    """State of the device, read in its process and not over the wire."""

    driven: bool  # an output is not zero, or an active law may change one
    struck: int  # number of frames that faults of the wire have affected


class FaultBench:
    """The host's handle of the process, which serves one bench at a time."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def begin(
        self, rig: Rig, wire: str, faults: Sequence[Fault], seed: int, *, realtime: bool
    ) -> str:
        """Serve a new bench with faults of machine and device; return its endpoint."""
        return str(self._request("begin", rig, wire, tuple(faults), seed, realtime))

    def strike(self, faults: Sequence[WireFault]) -> None:
        """Start faults of the wire; their `at` and `until` [s] count from now."""
        self._request("strike", tuple(faults))

    def state(self) -> FaultBenchState:
        """Return the state of the device."""
        answer: FaultBenchState = self._request("state")
        return answer

    def end(self) -> None:
        """End the bench; another one can then be started."""
        self._request("end")

    def _request(self, *words: Any) -> Any:
        self._pipe.send(words)
        if not self._pipe.poll(_START_SECONDS):
            raise TimeoutError(f"the simulated bench does not answer {words[0]!r}")
        answer = self._pipe.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def at_zero(self, timeout: float) -> bool:
        """Return whether the device's outputs are at zero within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while self.state().driven:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True


@contextmanager
def fault_bench() -> Iterator[FaultBench]:
    """Start the process and end it afterwards; it also ends when the calling process ends."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    try:
        yield FaultBench(ours)
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.kill()


class _Child:
    """The served device, in its process: one or none."""

    def __init__(self) -> None:
        self._served: ServedDevice | None = None
        self._rate = 1.0

    def begin(
        self, rig: Rig, wire: str, faults: tuple[Fault, ...], seed: int, realtime: bool
    ) -> str:
        self.end()
        scenario = Scenario(faults=faults)
        plant = FaultyPlant(rig, scenario, seed)
        self._rate, self._plant = rig.sample_rate, plant
        device = Device(
            rig, plant, realtime=realtime, virtual_silence=SILENCE, faults=scenario.device_faults
        )
        self._served = ServedDevice(device, wire, seed=seed, seconds=self._seconds)
        return self._served.link.endpoint

    def _seconds(self) -> float:
        return self._plant.tick / self._rate

    def strike(self, faults: tuple[WireFault, ...]) -> None:
        assert self._served is not None
        now = self._seconds()
        shifted = [
            fault.model_copy(
                update={
                    "at": now + fault.at,
                    "until": None if fault.until is None else now + fault.until,
                }
            )
            for fault in faults
        ]
        self._served.link.use(shifted)

    def state(self) -> FaultBenchState:
        served = self._served
        assert served is not None
        device = served.device
        driven = served.inside(lambda: device.laws.armed or bool(device.outputs.any()))
        return FaultBenchState(driven, sum(served.link.injected.values()))

    def end(self) -> None:
        served, self._served = self._served, None
        if served is not None:
            served.close()


def _serve(pipe: Connection) -> None:
    child = _Child()
    try:
        while True:
            word, *arguments = pipe.recv()
            try:
                pipe.send(getattr(child, word)(*arguments))
            except Exception as error:
                pipe.send(error)
    except (EOFError, OSError, KeyboardInterrupt):
        child.end()
