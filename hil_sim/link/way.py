"""One direction of a link: frames in, changed pieces out, each at its time. No sockets, no clock.

A *way* is one direction of one connection. Its fault injector exists as long as the link, so that
the faults of a new connection differ.
"""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hil_sim.faults.wire import Carrier, End, Piece, Release, WireFault
from hil_sim.link.frames import Cutter, every_frame, no_error

logger = logging.getLogger(__name__)

STREAM: Final = 4  # of a bench's seed; 0 to 3 are the plant's, drawn scenarios' and its faults'
QUIET: Final = 0.02  # [s] after which an incomplete frame is forwarded unchanged
MOST_WAITING: Final = 8192  # bytes that a way buffers at most


class FaultInjector:
    """Draws, by a seed, the frames of one way that each fault changes."""

    def __init__(
        self,
        way: str,
        faults: Sequence[WireFault],
        seed: Sequence[int],
        carrier: Carrier = Carrier.LINE,
    ) -> None:
        self.way = way
        self._carrier = carrier
        self._rng = np.random.default_rng([*seed, STREAM])
        self._faults: tuple[WireFault, ...] = ()
        self._injected: Counter[int] = Counter()
        self.counts: Counter[str] = Counter()
        self.use(faults)

    def use(self, faults: Sequence[WireFault]) -> None:
        """Inject other faults from the next frame on; their counts restart."""
        self._injected = Counter()
        self._faults = tuple(fault for fault in faults if fault.affects(self.way))

    def inject(self, frame: bytes, seconds: float, error: bytes = b"") -> Sequence[Piece]:
        """Return the pieces of a frame at `seconds` of the device's time; one fault per frame.

        `error` is the adapter's text for a frame that its controller has dropped.
        """
        for number, fault in enumerate(self._faults):
            until = math.inf if fault.until is None else fault.until
            exhausted = fault.most is not None and self._injected[number] >= fault.most
            if exhausted or not fault.at <= seconds < until:
                continue
            if fault.probability < 1.0 and self._rng.random() >= fault.probability:
                continue
            self._injected[number] += 1
            self.counts[fault.name] += 1
            logger.info("%.3f s: %s, %s, %d bytes", seconds, fault.name, self.way, len(frame))
            return fault.on(self._carrier, frame, self._rng, error)
        return (Piece(frame),)


@dataclass(frozen=True)
class _Due:
    """A piece with its earliest time of sending [s of the wall clock]."""

    at: float
    piece: Piece


class Way:
    """The frames of one direction of one connection, in order unless a fault changes it."""

    def __init__(
        self,
        injector: FaultInjector,
        cut: Cutter,
        on_wire: Callable[[bytes], bool] = every_frame,
        error_of: Callable[[bytes], bytes] = no_error,
    ) -> None:
        """Forward the frames that `cut` separates; faults affect only those with `on_wire` true."""
        self._injector, self._cut = injector, cut
        self._on_wire, self._error_of = on_wire, error_of
        self._buffer = b""
        self._last = 0.0
        self._ready: deque[_Due] = deque()
        self._after_next: list[Piece] = []  # waiting for the next frame to be sent first
        self._held: list[_Due] = []  # to be sent in one piece with the next frame, or at their time
        self._for_other_way: list[Piece] = []  # for the other way's next frame
        self.ended = False

    @property
    def full(self) -> bool:
        """Whether so much is buffered that no more should be read."""
        return sum(len(due.piece.data) for due in self._ready) > MOST_WAITING

    def take(self, data: bytes, now: float, seconds: float) -> int:
        """Add bytes; return the number of frames completed."""
        self._buffer += data
        self._last = now
        frames = 0
        while length := self._cut(self._buffer):
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            frames += self._frame(frame, now, seconds)
        return frames

    def other_way(self, now: float) -> None:
        """Release late answers, after a frame of the other direction."""
        late, self._for_other_way = self._for_other_way, []
        self._queue(late, now)

    def restore(self) -> None:
        """Restore a way that a fault has ended."""
        self.ended = False

    def due(self, now: float) -> list[Piece]:
        """Return the pieces to be sent now."""
        quiet = bool(self._buffer) and now - self._last > QUIET
        while self._held and (quiet or self._held[0].at <= now):  # older than the buffer
            self._queue([replace(self._held.pop(0).piece, wait=0.0)], now)
        if quiet:
            incomplete, self._buffer = self._buffer, b""
            self._queue([Piece(incomplete)], now)
        chunks = []
        while self._ready and self._ready[0].at <= now:
            chunks.append(self._ready.popleft().piece)
        return chunks

    def next_time(self) -> float:
        """Return the earliest time [s] of the next piece, inf if none is known."""
        times = [due.at for due in (*list(self._ready)[:1], *self._held[:1])]
        return min([*times, *([self._last + QUIET] if self._buffer else [])], default=math.inf)

    def _frame(self, frame: bytes, now: float, seconds: float) -> bool:
        """Queue the pieces of one frame; return whether it is of the wire, not of the adapter."""
        if not self._on_wire(frame):
            self._queue([] if self.ended else [Piece(frame)], now)
            return False
        if self.ended:
            return True
        pieces = list(self._injector.inject(frame, seconds, self._error_of(frame)))
        held_data, self._held = b"".join(due.piece.data for due in self._held), []
        after_this, self._after_next = self._after_next, []
        if held_data:
            first = pieces.pop(0) if pieces else Piece(b"")
            pieces.insert(0, replace(first, data=held_data + first.data))
        self._queue(pieces, now)
        self._queue([replace(piece, release=Release.TIME) for piece in after_this], now)
        return True

    def _queue(self, pieces: Sequence[Piece], now: float) -> None:
        for piece in pieces:
            if piece.release is Release.NEXT_FRAME:
                self._after_next.append(piece)
            elif piece.release is Release.WITH_NEXT:
                held = replace(piece, release=Release.TIME)
                self._held.append(_Due(now + piece.wait, held))
            elif piece.release is Release.OTHER_WAY:
                self._for_other_way.append(replace(piece, release=Release.TIME))
            else:
                last = self._ready[-1].at if self._ready else now
                self._ready.append(_Due(max(last, now) + piece.wait, piece))
            self.ended = self.ended or piece.end is not End.NONE
