"""Faults of the wire: changes of the frames between host and device, on any wire.

A wire fault turns a frame into pieces of bytes, each with its time of release, and may end the
link. `hil_sim.link` executes it on TCP, on pseudo-terminals and behind CAN adapters. `cut` and
`until` are seconds of the device's time; delays are by the wall clock, like a host's timeouts.
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
    """The event that a piece waits for."""

    TIME = auto()  # its own wait
    NEXT_FRAME = auto()  # the next frame of its way, which it then follows
    WITH_NEXT = auto()  # the next frame of its way, with which it goes in one piece
    OTHER_WAY = auto()  # the next frame of the other way: the host's next request


class End(Enum):
    """The part of the link that a piece ends."""

    NONE = auto()
    WAY = auto()
    LINK = auto()


class Carrier(Enum):
    """The layer below the frames, which handles damaged ones."""

    LINE = auto()  # nothing: the damaged bytes arrive
    TCP = auto()  # its checksum and its sending again
    CAN = auto()  # the controllers: their CRC, and error frames


@dataclass(frozen=True)
class Piece:
    """Bytes sent together, `wait` [s] after their release; `end` acts when they have been sent."""

    data: bytes
    wait: float = 0.0
    release: Release = Release.TIME
    end: End = End.NONE


class WireFault(Fault):
    """A fault of frames: each with `probability`, at most `most` of them in each direction."""

    way: Literal["to host", "to device", "both"] = TO_HOST
    probability: Ratio = Field(default=1.0, gt=0, le=1)
    most: int | None = Field(default=None, ge=1)

    @property
    def place(self) -> str:
        """The direction of the frames that it affects."""
        return self.way

    def affects(self, way: str) -> bool:
        """Return whether it acts on the frames of a direction."""
        return self.way in (way, BOTH)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Return the pieces that a frame becomes."""
        raise NotImplementedError

    def on(
        self, carrier: Carrier, frame: bytes, rng: np.random.Generator, error: bytes = b""
    ) -> Sequence[Piece]:
        """Return the pieces that a frame becomes on a carrier.

        `error` is the text of a CAN adapter for an error frame, empty if it reports none.
        """
        del carrier, error
        return self.spoil(frame, rng)


class FrameLost(WireFault):
    """The frame does not arrive."""

    name: Literal["frame_lost"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Send nothing."""
        return ()


class FrameLate(WireFault):
    """The frame and all that follow it arrive `delay` late."""

    name: Literal["frame_late"]
    delay: Time = Field(default=0.05, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Delay the frame."""
        return (Piece(frame, self.delay),)


class LateAnswer(WireFault):
    """The answer arrives after the host has repeated its request, before the answer to that."""

    name: Literal["late_answer"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame until the other end sends one."""
        return (Piece(frame, release=Release.OTHER_WAY),)


class FrameDuplicated(WireFault):
    """The frame arrives twice."""

    name: Literal["frame_duplicated"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Send the frame twice."""
        return Piece(frame), Piece(frame)


class FramesReordered(WireFault):
    """The frame arrives after the next one."""

    name: Literal["frames_reordered"]

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame until the next one has been sent."""
        return (Piece(frame, release=Release.NEXT_FRAME),)


class FrameSplit(WireFault):
    """The frame arrives in two pieces, `pause` apart."""

    name: Literal["frame_split"]
    pause: Time = Field(default=0.01, ge=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Cut the frame at a random place."""
        cut = int(rng.integers(1, max(2, len(frame))))
        return Piece(frame[:cut]), Piece(frame[cut:], self.pause)


class FramesMerged(WireFault):
    """The frame arrives in one piece with the next one, if that comes within `hold`."""

    name: Literal["frames_merged"]
    hold: Time = Field(default=0.03, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame for the next one."""
        return (Piece(frame, self.hold, Release.WITH_NEXT),)


class BitsFlipped(WireFault):
    """Some `bits` of the frame, drawn at random, are inverted.

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
        """Invert bits, each in another place."""
        flipped = bytearray(frame)
        count = min(self.bits, 8 * len(frame))
        for bit in rng.choice(8 * len(frame), size=count, replace=False):
            flipped[bit // 8] ^= 1 << bit % 8
        return (Piece(bytes(flipped)),)


class Stall(WireFault):
    """Nothing passes for `time`, then all held frames."""

    name: Literal["stall"]
    way: Literal["to host", "to device", "both"] = BOTH
    most: int | None = Field(default=1, ge=1)
    time: Time = Field(default=0.3, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Hold the frame and with it all that follow."""
        return (Piece(frame, self.time),)


class SlowConsumer(WireFault):
    """The receiver accepts no more than `rate` bytes a second."""

    name: Literal["slow_consumer"]
    rate: Annotated[float, in_unit("s^-1")] = Field(default=10_000.0, gt=0)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Delay the frame by its length over the rate."""
        return (Piece(frame, len(frame) / self.rate),)


class LinkHalfClosed(WireFault):
    """One direction of the link ends; the other one continues."""

    name: Literal["link_half_closed"]
    most: int | None = Field(default=1, ge=1)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """End the direction instead of sending the frame."""
        return (Piece(b"", end=End.WAY),)


class LinkClosed(WireFault):
    """The link ends in both directions, in the middle of a frame, like a cable pulled out."""

    name: Literal["link_closed"]
    most: int | None = Field(default=1, ge=1)

    def spoil(self, frame: bytes, rng: np.random.Generator) -> Sequence[Piece]:
        """Send half of the frame, then end the link."""
        return (Piece(frame[: len(frame) // 2], end=End.LINK),)
