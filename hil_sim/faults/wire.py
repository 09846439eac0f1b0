"""Faults of the wire: what happens to the frames between host and device, whatever the wire is.

A wire fault says what becomes of one frame: pieces of bytes, when each may go on, and whether the
link ends. `hil_sim.link` carries it out on TCP, on pseudo-terminals and behind CAN adapters. `at`
and `until` are seconds of the device's time; delays are of the wall's clock, as a host's patience
is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from hil_sim.effects.base import in_unit
from hil_sim.faults.base import Fault
from rig.model.quantity import Ratio, Time

TO_HOST: Final = "to host"
TO_DEVICE: Final = "to device"
BOTH: Final = "both"
TCP_SENDS_AGAIN: Final = 0.2  # [s]: the least time of Linux after which TCP does


class Release(Enum):
    """What a piece waits for before it goes on."""

    TIME = auto()  # its own wait
    NEXT_FRAME = auto()  # the next frame of its way, which it then follows
    WITH_NEXT = auto()  # the next frame of its way, with which it goes in one piece
    OTHER_WAY = auto()  # the next frame of the other way: the host's next request


class End(Enum):
    """Which part of the link a piece ends."""

    NONE = auto()
    WAY = auto()
    LINK = auto()


class Carrier(Enum):
    """What lies beneath the frames and deals with damaged ones."""

    LINE = auto()  # nothing: the damaged bytes arrive
    TCP = auto()  # its checksum and its sending again
    CAN = auto()  # the controllers: their CRC, and error frames


@dataclass(frozen=True)
class Piece:
    """Bytes that go on together, `wait` [s] after their release; `end` acts when they have gone."""

    data: bytes
    wait: float = 0.0
    release: Release = Release.TIME
    end: End = End.NONE


class WireFault(Fault):
    """A fault that strikes frames: each with `probability`, at most `most` of them on each way."""

    way: Literal["to host", "to device", "both"] = TO_HOST
    probability: Ratio = Field(default=1.0, gt=0, le=1)
    most: int | None = Field(default=None, ge=1)

    @property
    def place(self) -> str:
        """Which way the frames go that it strikes."""
        return self.way

    def strikes(self, way: str) -> bool:
        """Return whether it acts on the frames of a way."""
        return self.way in (way, BOTH)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Return what becomes of a frame."""
        raise NotImplementedError

    def on(
        self, carrier: Carrier, frame: bytes, rng: np.random.Generator, error: bytes = b""
    ) -> Sequence[Piece]:
        """Return what becomes of a frame by what lies beneath it.

        `error` is what a CAN adapter hands on for an error frame, nothing where it hands none on.
        """
        del carrier, error
        return self.spoil(frame, rng)


class FrameLost(WireFault):
    """The frame does not arrive."""

    name: Literal["frame_lost"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Let nothing go on."""
        return ()


class FrameLate(WireFault):
    """The frame arrives `delay` late, and what follows it not before it."""

    name: Literal["frame_late"]
    delay: Time = Field(default=0.05, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame for a time."""
        return (Piece(frame, self.delay),)


class LateAnswer(WireFault):
    """The answer arrives after the host has asked again, before the answer to that request."""

    name: Literal["late_answer"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame until the other end sends one."""
        return (Piece(frame, release=Release.OTHER_WAY),)


class FrameDuplicated(WireFault):
    """The frame arrives twice."""

    name: Literal["frame_duplicated"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Send the frame two times."""
        return Piece(frame), Piece(frame)


class FramesReordered(WireFault):
    """The frame arrives behind the one after it."""

    name: Literal["frames_reordered"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame until the next one has gone."""
        return (Piece(frame, release=Release.NEXT_FRAME),)


class FrameSplit(WireFault):
    """The frame arrives in two pieces, `pause` apart."""

    name: Literal["frame_split"]
    pause: Time = Field(default=0.01, ge=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Cut the frame at a random place."""
        at = int(rng.integers(1, max(2, len(frame))))
        return Piece(frame[:at]), Piece(frame[at:], self.pause)


class FramesMerged(WireFault):
    """The frame arrives in one piece with the next one, if that comes within `hold`."""

    name: Literal["frames_merged"]
    hold: Time = Field(default=0.03, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame for the next one."""
        return (Piece(frame, self.hold, Release.WITH_NEXT),)


class BitsFlipped(WireFault):
    """Some `bits` of the frame, drawn at random, are turned.

    TCP's own checksum drops such a frame and sends it again; on a CAN bus the controllers drop it
    by its CRC and answer with an error frame. `past_checksum` lets it pass, as behind a gateway or
    on an adapter's own line that damages what it hands on.
    """

    name: Literal["bits_flipped"]
    bits: int = Field(default=1, ge=1, le=64)
    past_checksum: bool = False

    def on(
        self, carrier: Carrier, frame: bytes, rng: np.random.Generator, error: bytes = b""
    ) -> Sequence[Piece]:
        """Let TCP send the frame again, unless past its checksum; on CAN an error frame comes.

        Controllers send a damaged frame again by themselves; here it stays lost, as for a receiver
        that alone saw the damage in the last bit, or with automatic retransmission switched off.
        """
        if carrier is Carrier.LINE or self.past_checksum:
            return self.spoil(frame, rng)
        if carrier is Carrier.TCP:
            return (Piece(frame, TCP_SENDS_AGAIN),)
        return (Piece(error),) if error else ()

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Turn bits, each in another place."""
        turned = bytearray(frame)
        count = min(self.bits, 8 * len(frame))
        for bit in rng.choice(8 * len(frame), size=count, replace=False):
            turned[bit // 8] ^= 1 << bit % 8
        return (Piece(bytes(turned)),)


class Stall(WireFault):
    """Nothing passes for `time`, then everything that was held."""

    name: Literal["stall"]
    way: Literal["to host", "to device", "both"] = BOTH
    most: int | None = Field(default=1, ge=1)
    time: Time = Field(default=0.3, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame and with it all that follow."""
        return (Piece(frame, self.time),)


class SlowConsumer(WireFault):
    """The receiver takes no more than `rate` of bytes a second."""

    name: Literal["slow_consumer"]
    rate: Annotated[float, in_unit("s^-1")] = Field(default=10_000.0, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Let the frame take its time."""
        return (Piece(frame, len(frame) / self.rate),)


class LinkHalfClosed(WireFault):
    """One way of the link ends; the other one goes on."""

    name: Literal["link_half_closed"]
    most: int | None = Field(default=1, ge=1)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """End the way instead of carrying the frame."""
        return (Piece(b"", end=End.WAY),)


class LinkClosed(WireFault):
    """The link ends in both ways, in the middle of a frame: a cable pulled out."""

    name: Literal["link_closed"]
    most: int | None = Field(default=1, ge=1)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Send half of the frame, then end the link."""
        return (Piece(frame[: len(frame) // 2], end=End.LINK),)
