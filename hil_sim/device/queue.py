"""The device's queue of sample blocks: numbered, kept until acknowledged, bounded."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rig.model.wire.codes import Codes
from rig.model.wire.registers import BlockLayout, pack_samples


@dataclass(frozen=True)
class QueuedBlock:
    """One finished block: its number, the tick of its first sample, its samples as bytes."""

    sequence: int
    tick: int
    samples: bytes


class BlockQueue:
    """A FIFO; when full, the oldest block is dropped and the numbers show the gap."""

    def __init__(self, layout: BlockLayout, capacity: int) -> None:
        self._layout = layout
        self._capacity = capacity
        self._blocks: deque[QueuedBlock] = deque()
        self._parts: list[tuple[Codes, Codes]] = []
        self._filled = 0
        self._tick = 0
        self._offered_sequence: int | None = None
        self.next_sequence = 0
        self.dropped = 0
        self._to_lose = 0

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def room(self) -> int:
        """Number of samples that the block being filled still needs."""
        return self._layout.samples - self._filled

    def clear(self) -> None:
        """Empty the queue and restart the numbers at 0."""
        self._blocks.clear()
        self._parts.clear()
        self._filled = 0
        self._offered_sequence = None
        self.next_sequence = 0
        self.dropped = 0

    def lose_next(self, blocks: int) -> None:
        """Lose the next `blocks` blocks as if they were overwritten before they were read."""
        self._to_lose = blocks

    def add(self, tick: int, measured: Codes, commands: Codes) -> None:
        """Append samples that start at `tick`, at most `room` of them."""
        if not self._parts:
            self._tick = tick
        self._parts.append((measured, commands))
        self._filled += len(measured)
        if self._filled < self._layout.samples:
            return
        rows: Sequence[Codes] = self._parts[0]
        if len(self._parts) > 1:
            rows = [np.concatenate(part) for part in zip(*self._parts, strict=True)]
        self._parts.clear()
        self._filled = 0
        if self._to_lose:
            self._to_lose -= 1
            self.dropped += 1
            self.next_sequence = (self.next_sequence + 1) & 0xFFFF
            return
        if len(self._blocks) == self._capacity:
            self._blocks.popleft()
            self.dropped += 1
        self._blocks.append(QueuedBlock(self.next_sequence, self._tick, pack_samples(*rows)))
        self.next_sequence = (self.next_sequence + 1) & 0xFFFF

    def acknowledge(self, sequence: int) -> None:
        """Drop the oldest block if it is the one last offered and has this number."""
        if self._blocks and self._offered_sequence == sequence == self._blocks[0].sequence:
            self._blocks.popleft()
            self._offered_sequence = None

    def release(self, sequence: int) -> None:
        """Drop all blocks up to number `sequence`, if that one is waiting."""
        if self._blocks:
            count = ((sequence - self._blocks[0].sequence) & 0xFFFF) + 1
            for _ in range(count if count <= len(self._blocks) else 0):
                self._blocks.popleft()

    def queued(self, index: int) -> QueuedBlock | None:
        """Return the waiting block at `index`, 0 being the oldest, None if there is none."""
        return self._blocks[index] if index < len(self._blocks) else None

    def offer(self) -> QueuedBlock | None:
        """Return the oldest block, which is kept until acknowledged."""
        if not self._blocks:
            return None
        self._offered_sequence = self._blocks[0].sequence
        return self._blocks[0]
