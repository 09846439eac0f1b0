"""From the bytes of a block to SI samples, and whether it can follow the block before."""

from __future__ import annotations

import logging

import numpy as np

from drivers.base import DeviceError, DeviceLost, SampleBlock
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.registers import BlockHeader, Status

logger = logging.getLogger(__name__)

_ONE = np.uint16(1)
LATE = 16  # blocks back that a late answer may be of


def unwrap(raw: int, near: int, bits: int) -> int:
    """Return the number congruent to `raw` modulo 2^bits that is nearest to `near`."""
    size = 1 << bits
    return near + (raw - near + size // 2) % size - size // 2


class BlockDecoder:
    """Decodes the blocks of one stream in order; knows what the next one must look like."""

    def __init__(self, rig: Rig) -> None:
        self.layout = reg.block_layout(len(rig.channels), len(rig.joints))
        sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
        self._names = rig.recorded
        low = np.array([sensor.range[0] for sensor in sensors])
        high = np.array([sensor.range[1] for sensor in sensors])
        self._top = np.array([(1 << sensor.bits) - 1 for sensor in sensors])
        self._almost_top = (self._top - 1).astype(np.uint16)
        self._narrow = bool((self._top < 0xFFFF).any())  # a wider code has no register to be in
        step = (high - low) / self._top
        most = [(1 << (j.valve.command_bits - 1)) - 1 for j in rig.joints]
        self._most = np.array(most, dtype=np.int16)
        self._span = 2 * self._most.astype(np.uint16)
        volt = np.array([j.valve.command_range for j in rig.joints]) / np.array(most)
        self._scale = np.concatenate([step, volt])
        self._offset = np.concatenate([low, np.zeros(len(volt))])
        self._sequence: int | None = None
        self.tick = 0  # of the sample expected next

    @property
    def acknowledge(self) -> int:
        """The number of the last block decoded; before the first one a number never offered."""
        return 0xFFFF if self._sequence is None else self._sequence & 0xFFFF

    def restart(self, tick: int | None = None) -> None:
        """Expect a stream numbered anew; `tick` is where another device's clock stands."""
        self._sequence = None
        if tick is not None:
            self.tick = tick

    def seen(self, header: BlockHeader) -> bool:
        """Return whether a block is one of the last few decoded: a late copy of an answer."""
        behind = (self.acknowledge - header.sequence) & 0xFFFF
        return self._sequence is not None and behind <= min(self._sequence, LATE)

    def refuse_restarted(self, tick: int) -> None:
        """Raise DeviceLost where a device counts `tick` (modulo 2^32) after samples beyond it."""
        now = unwrap(tick, self.tick, 32)
        if now < self.tick:
            raise DeviceLost(
                f"the device has restarted: it counts sample {tick} where {self.tick} or a later "
                "one was due; its waveforms and laws are gone"
            )

    def decode(self, header: BlockHeader, answer: bytes) -> SampleBlock:
        """Return the block in SI of an answer that begins with its header; as `decode_samples`."""
        return self.decode_samples(header, answer[2 * reg.HEADER_WORDS :])

    def decode_samples(self, header: BlockHeader, samples: bytes) -> SampleBlock:
        """Return the block in SI; raises DeviceError if it is impossible after the last one."""
        sequence, tick = self._follow(header)
        codes, outputs = reg.unpack_samples(samples, self.layout)
        if self._narrow:
            self._possible(codes > self._top, codes, 0)
        # |output| > most, by one comparison: below -most the sum wraps to the largest codes.
        shifted = (outputs + self._most).view(np.uint16)
        self._possible(shifted > self._span, outputs, codes.shape[1])
        data = np.empty((self.layout.samples, self.layout.columns))
        data[:, : self.layout.channels] = codes
        data[:, self.layout.channels :] = outputs
        data *= self._scale  # whole rows: a third of the time of both parts by themselves
        data += self._offset
        self._sequence, self.tick = sequence, tick + self.layout.samples
        return SampleBlock(
            sequence=sequence,
            tick=tick,
            data=data,
            saturated=codes - _ONE >= self._almost_top,  # 0 wraps to the largest code
            backlog=header.backlog,
            tripped=bool(header.status & Status.TRIPPED),
        )

    def _follow(self, header: BlockHeader) -> tuple[int, int]:
        """Return unwrapped (sequence, tick), if the numbers can be those of the next block."""
        tick = unwrap(header.tick, self.tick, 32)
        last = -1 if self._sequence is None else self._sequence
        lost = (header.sequence - last - 1) & 0xFFFF
        expected = self.tick + lost * self.layout.samples
        # Before a stream's first block any time may pass, but none backwards.
        if lost > 0x7FFF or tick < expected or (tick > expected and self._sequence is not None):
            raise DeviceError(
                f"impossible block: number {header.sequence} at sample {tick}, expected number "
                f"{(last + 1) & 0xFFFF} at sample {self.tick} or a later one that fits"
            )
        if lost:
            logger.warning("the device dropped %d blocks before sample %d", lost, tick)
        return last + 1 + lost, tick

    def _possible(
        self, wrong: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], codes: object, first: int
    ) -> None:
        if np.count_nonzero(wrong):
            row, column = np.argwhere(wrong)[0]
            raise DeviceError(
                f"impossible block: channel {self._names[first + column]} has the converter code "
                f"{np.asarray(codes)[row, column]}, more than its bits can hold"
            )
