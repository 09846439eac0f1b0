"""Decode a block's bytes to SI samples, with checks against the previous block."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import Array, DeviceError, DeviceLost, SampleBlock
from drivers.settings import DRIVER
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.registers import BlockHeader, Status

logger = logging.getLogger(__name__)

Flags = NDArray[np.bool_]
Codes = NDArray[np.uint16]

_ARMED: Final = int(Status.ARMED)
_TRIPPED: Final = int(Status.TRIPPED)  # an operation on a flag takes as long as one on an array


def unwrap(raw: int, near: int, bits: int) -> int:
    """Return the number congruent to `raw` modulo 2^bits that is nearest to `near`."""
    size = 1 << bits
    return near + (raw - near + size // 2) % size - size // 2


class BlockDecoder:
    """Decodes the blocks of one stream in order, and knows the next number and tick expected."""

    def __init__(self, rig: Rig) -> None:
        self.layout = reg.block_layout(len(rig.channels), len(rig.joints))
        self._shape = self.layout.samples, self.layout.columns
        sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
        self._names = rig.recorded
        low = np.array([sensor.range[0] for sensor in sensors])
        high = np.array([sensor.range[1] for sensor in sensors])
        top = np.array([(1 << sensor.bits) - 1 for sensor in sensors])
        step = (high - low) / top
        most = np.array([(1 << (j.valve.command_bits - 1)) - 1 for j in rig.joints])
        volt = np.array([j.valve.command_range for j in rig.joints]) / most
        # An output's code counts from -most; with `most` added all codes count from 0. One below
        # -most becomes one of the largest, so that a single comparison finds every impossible code.
        self._code_offset = self._rows([np.zeros(len(top)), most], np.uint16)
        self._code_span = self._rows([top, 2 * most], np.uint16)
        self._ones = np.ones(self._shape, np.uint16)
        self._almost_top = self._rows([top - 1, 2 * most], np.uint16)
        self._scale = self._rows([step, volt], np.float64)
        self._offset = self._rows([low, -(most * volt)], np.float64)
        self.tick = 0  # of the next expected sample
        self.restart()

    def _rows(self, parts: Sequence[Array], kind: type[np.generic]) -> NDArray[Any]:
        """Return one value per column, repeated for every sample.

        Operations on arrays of a block's own shape are faster than broadcasting a row.
        """
        return np.tile(np.concatenate(parts).astype(kind), (self.layout.samples, 1))

    def restart(self, tick: int | None = None) -> None:
        """Expect a stream with new numbers; `tick` is the clock of another device."""
        self._sequence: int | None = None
        # The number of the last decoded block; before the first one, an unused number.
        self.acknowledge = 0xFFFF
        if tick is not None:
            self.tick = tick

    def was_decoded(self, header: BlockHeader) -> bool:
        """Return whether a block was decoded recently: a late copy of an answer."""
        behind = (self.acknowledge - header.sequence) & 0xFFFF
        return self._sequence is not None and behind <= min(self._sequence, DRIVER.late_blocks)

    def refuse_restarted(self, tick: int) -> None:
        """Raise DeviceLost if a device that has counted further is at `tick` (modulo 2^32)."""
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
        """Return the block in SI; raises DeviceError if it cannot follow the previous one."""
        sequence, tick = self._unwrapped(header)
        codes = np.frombuffer(samples, ">u2").reshape(self._shape).astype(np.uint16)
        codes += self._code_offset
        at_end = codes - self._ones >= self._almost_top  # 0 wraps to the top
        if np.count_nonzero(at_end):  # values beyond an end count as at the end
            impossible = codes > self._code_span
            if np.count_nonzero(impossible):
                raise self._impossible(impossible, codes)
        data = codes.astype(np.float64)
        data *= self._scale
        data += self._offset
        self._sequence, self.acknowledge = sequence, header.sequence
        self.tick = tick + self.layout.samples
        status = header.status
        return SampleBlock(
            sequence=sequence,
            tick=tick,
            data=data,
            saturated=at_end[:, : self.layout.channels],
            backlog=header.backlog,
            tripped=status & _TRIPPED != 0,
            armed=status & _ARMED != 0,
        )

    def _unwrapped(self, header: BlockHeader) -> tuple[int, int]:
        """Return unwrapped (sequence, tick) if the numbers can be those of the next block."""
        in_order = header.sequence == (self.acknowledge + 1) & 0xFFFF
        if in_order and self._sequence is not None and header.tick == self.tick & 0xFFFFFFFF:
            return self._sequence + 1, self.tick
        tick = unwrap(header.tick, self.tick, 32)
        last = -1 if self._sequence is None else self._sequence
        lost = (header.sequence - last - 1) & 0xFFFF
        expected = self.tick + lost * self.layout.samples
        # Before a stream's first block any time may pass, but never backwards.
        if lost > 0x7FFF or tick < expected or (tick > expected and self._sequence is not None):
            raise DeviceError(
                f"impossible block: number {header.sequence} at sample {tick}, expected number "
                f"{(last + 1) & 0xFFFF} at sample {self.tick} or a later one that fits"
            )
        if lost:
            logger.warning("the device dropped %d blocks before sample %d", lost, tick)
        return last + 1 + lost, tick

    def _impossible(self, selected: Flags, codes: Codes) -> DeviceError:
        """Return the error of the first selected code."""
        row, column = np.argwhere(selected)[0]
        code = codes[row, column] - self._code_offset[row, column]
        signed = code if column < self.layout.channels else code.view(np.int16)
        return DeviceError(
            f"impossible block: channel {self._names[column]} has the converter code {signed}, "
            "more than its bits can hold"
        )
