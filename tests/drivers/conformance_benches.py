"""Subjects of the conformance checks: the integrator behind each wire, its clock in our hands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final, Literal
from unittest.mock import patch

import numpy as np

from drivers import make_driver, message_stream, modbus_tcp, wire_at
from drivers.conformance import HEALTHY, Capabilities, DeviceUnderTest, Subject
from hil_sim.device.device import Device
from hil_sim.device.server import CAN, RTU, SERIAL, SLCAN, TCP
from hil_sim.faults.wire import (
    BitsFlipped,
    FrameDuplicated,
    FrameLate,
    FrameLost,
    FramesMerged,
    FrameSplit,
    FramesReordered,
    LateAnswer,
    LinkClosed,
    LinkHalfClosed,
    Piece,
    SlowConsumer,
    Stall,
    WireFault,
)
from hil_sim.link.served import ServedDevice
from rig.model import channels as ch
from rig.model.rig import Rig
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

TIMEOUT = 0.5
STEP = 0.09  # [s] of the device's clock between two polls: less than what it takes for a stall
SILENCE = 2.0  # [s] of the device's clock until its watchdog acts


class Replaced(WireFault):
    """Modbus TCP only: an answer that is another one than was asked for."""

    name: Literal["replaced"] = "replaced"
    form: str

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Return a text, half an answer, one of fewer registers, one of a wrong count."""
        data = {
            "garbage": b"HTTP/1.1 400 Bad Request\r\n\r\n",
            "short": frame[: len(frame) // 2],
            "fewer": frame[:4] + bytes([0, 7, *frame[6:8], 4]) + frame[9:13],
            "miscounted": frame[:8] + bytes([frame[8] ^ 2]) + frame[9:],
        }[self.form]
        return (Piece(data),)


EVERYWHERE: Final[Mapping[str, WireFault]] = {
    "lose one": FrameLost(name="frame_lost", most=1),
    "silent": FrameLost(name="frame_lost"),
    "deaf": FrameLost(name="frame_lost", way="to device", most=1),
    "late": FrameLate(name="frame_late", delay=0.02),
    "late answer": LateAnswer(name="late_answer", most=1),
    "twice": FrameDuplicated(name="frame_duplicated"),
    "reordered": FramesReordered(name="frames_reordered", most=1),
    "split": FrameSplit(name="frame_split"),
    "merged": FramesMerged(name="frames_merged", most=3),
    "stall": Stall(name="stall", time=0.1),
    "slow": SlowConsumer(name="slow_consumer", rate=20_000.0),
    "half closed": LinkHalfClosed(name="link_half_closed", most=None),
    "close": LinkClosed(name="link_closed", most=None),
}
FLIP = BitsFlipped(name="bits_flipped", most=3)
# A block is some thirty lines of text, each late by itself: by more, the line carries no block.
LATE_LINE = FrameLate(name="frame_late", delay=0.002)
DAMAGED_TEXT = BitsFlipped(name="bits_flipped", bits=3, most=3, past_checksum=True)
LOST = ("silent", "half closed", "close")
FAULTS: Final[Mapping[str, Mapping[str, WireFault]]] = {
    TCP: {
        **EVERYWHERE,
        **{form: Replaced(form=form) for form in ("garbage", "short", "fewer", "miscounted")},
    },
    RTU: {**EVERYWHERE, "flip": FLIP},
    SERIAL: {**EVERYWHERE, "flip": FLIP},
    CAN: {**EVERYWHERE, "flip": FLIP},
    SLCAN: {**EVERYWHERE, "late": LATE_LINE, "flip": FLIP, "damaged text": DAMAGED_TEXT},
}
# What `make test` tries: on TCP the quickest that between them reach every branch, elsewhere what
# that wire alone can suffer. `make study NAME=conformance` takes all.
FEW: Final[Mapping[str, Sequence[str]]] = {
    TCP: ("lose one", "late answer", "close", "short", "fewer", "miscounted"),
    RTU: ("late answer", "twice"),
    SERIAL: ("flip", "merged"),
    CAN: ("flip", "late answer"),
    SLCAN: ("damaged text",),
}


class Held:
    """The integrator's device, whose clock stands still but for `pass_time`.

    So no busy computer trips its watchdog.
    """

    def __init__(self, wire: str) -> None:
        self.rig = seed_rig()
        self.now = 100.0
        self.plant = IntegratorPlant(self.rig)
        self._served: ServedDevice | None = None
        self._passing = False  # time is passed by `silence`
        device = Device(
            self.rig, self.plant, realtime=False, clock=self._clock, virtual_silence=SILENCE
        )
        self.served = self._served = ServedDevice(device, wire)

    def _clock(self) -> float:
        if self._served is not None and self._served.deserted and not self._passing:
            self.now += STEP
        return self.now

    def outputs(self) -> list[float]:
        """Return the outputs [V] after one more block of the device's clock."""
        device = self.served.device

        def run() -> list[float]:
            device._run(device.queue.room)
            return list(self.plant.volts)

        return self.served.inside(run)

    def silence(self) -> None:
        """Let the device's clock pass by more than its watchdog allows."""

        def wait() -> None:
            self._passing = True
            for _ in range(round(1.1 * SILENCE / STEP)):
                self.now += STEP
                self.served.device.poll()
            self._passing = False

        self.served.inside(wait)

    def saturate(self) -> int:
        """Move the first piston beyond its sensor."""
        self.plant.piston[0] = 1.0
        return self.rig.channels.index(f"{ch.PISTON}_1")


def _bench(wire: str, names: Sequence[str]) -> Iterator[DeviceUnderTest]:
    held = Held(wire)
    link = held.served.link
    known = FAULTS[wire]

    def spoil(fault: str) -> None:
        link.use([] if fault == HEALTHY else [known[fault]])

    def cut() -> None:
        link.cut()
        if wire in (CAN, SLCAN):  # a node of a bus does not see a program end: its watchdog does
            held.silence()

    def driver(rig: Rig) -> Any:
        quick = rig.wire.model_copy(update={"timeout": TIMEOUT})
        return make_driver(wire_at(link.endpoint, quick), rig)

    with ExitStack() as stack:
        stack.callback(held.served.close)
        # Let a virtual device's answers be lost as soon as a real one's.
        for module in (modbus_tcp, message_stream):
            stack.enter_context(patch.object(module, "VIRTUAL_TIMEOUT_FACTOR", 1.0))
        yield DeviceUnderTest(
            held.rig,
            driver,
            outputs=held.outputs,
            cut=cut,
            silence=held.silence,
            spoil=spoil,
            faults=tuple(names),
            lost=tuple(name for name in LOST if name in names) or LOST[:1],
            saturate=held.saturate,
        )


def on_wire(wire: str, names: Sequence[str] | None = None) -> Subject:
    """The driver of a wire, its link spoiled by the faults of these names, by default all."""
    faults = tuple(FAULTS[wire]) if names is None else tuple(names)
    make: Callable[[], Any] = contextmanager(lambda: _bench(wire, faults))
    return Subject(wire, make, Capabilities())
