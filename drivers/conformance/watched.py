"""A wrapper that checks every call of a driver, and the continuity of its blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from drivers.base import Array, DeviceError, DeviceInfo, Driver, OutputLaw, SampleBlock
from rig.model.rig import Rig

Result = TypeVar("Result")


class NotConforming(AssertionError):
    """A driver violated a requirement, which the message names."""


class Skipped(Exception):
    """A check that cannot be made here, for the reason in the message."""


def require(condition: object, message: str) -> None:
    """Raise NotConforming with `message` unless `condition` is true."""
    if not condition:
        raise NotConforming(message)


class Watched:
    """A driver whose calls may raise only DeviceError and whose blocks must have the right form.

    It has the calls of `drivers.base.Driver`, keeps their names in `log` and the last `info`.
    """

    def __init__(self, driver: Driver, rig: Rig) -> None:
        self.unchecked = driver
        self.rig = rig
        self.log: list[str] = []
        self.info: DeviceInfo | None = None

    def _call(self, name: str, call: Callable[[], Result]) -> Result:
        self.log.append(name)
        try:
            return call()
        except DeviceError:
            self.log[-1] += " (error)"
            raise
        except Exception as error:
            raise NotConforming(
                f"{name} raised {type(error).__name__}: {error}; only DeviceLost and DeviceError "
                "may leave a driver"
            ) from error

    def connect(self) -> DeviceInfo:
        """Connect; return the device's info."""
        self.info = self._call("connect", self.unchecked.connect)
        return self.info

    def close(self) -> None:
        """Close; not even a DeviceError may be raised."""
        try:
            self._call("close", self.unchecked.close)
        except DeviceError as error:
            raise NotConforming(f"close raised {type(error).__name__}: {error}") from error

    def zero_outputs(self) -> None:
        """Zero the outputs."""
        self._call("zero_outputs", self.unchecked.zero_outputs)

    def upload(self, joint: int, wave: Array) -> None:
        """Upload a waveform [V]."""
        self._call(f"upload to joint {joint + 1}", lambda: self.unchecked.upload(joint, wave))

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Apply laws; the tick returned must be an integer, 0 or more."""
        name = "apply with restart" if restart else "apply"
        tick = self._call(name, lambda: self.unchecked.apply(laws, restart=restart))
        valid = isinstance(tick, int | np.integer) and tick >= 0
        require(valid, f"apply returned {tick!r}, not the tick at which the laws act")
        return int(tick)

    def start(self) -> None:
        """Start the stream."""
        self._call("start", self.unchecked.start)

    def stop(self) -> None:
        """Stop the stream."""
        self._call("stop", self.unchecked.stop)

    def reset(self) -> None:
        """Clear a trip."""
        self._call("reset", self.unchecked.reset)

    def trip_cause(self) -> str | None:
        """Return the cause of the trip; it must be a text or None."""
        cause = self._call("trip_cause", self.unchecked.trip_cause)
        fits = cause is None or (isinstance(cause, str) and cause != "")
        require(fits, f"trip_cause returned {cause!r}, neither None nor a text")
        return cause

    def read_block(self) -> SampleBlock:
        """Read one block; its arrays must have the rig's shapes."""
        block = self._call("read_block", self.unchecked.read_block)
        channels, columns = len(self.rig.channels), len(self.rig.recorded)
        rows = len(block.data)
        require(rows > 0, "read_block returned a block without samples")
        for name, actual, expected in (
            ("data", block.data.shape, (rows, columns)),
            ("saturated", block.saturated.shape, (rows, channels)),
        ):
            require(actual == expected, f"a block's {name} has shape {actual}, expected {expected}")
        require(block.saturated.dtype == np.bool_, "a block's saturated marks are not booleans")
        require(block.sequence >= 0, f"a block has the sequence number {block.sequence}")
        require(block.tick >= 0, f"a block has the tick {block.tick}")
        require(block.backlog >= 0, f"a block has the backlog {block.backlog}")
        return block

    def read(self, count: int) -> list[SampleBlock]:
        """Read `count` blocks, in order or with the missing ones counted."""
        blocks = [self.read_block() for _ in range(count)]
        for before, after in pairwise(blocks):
            follows(before, after)
        return blocks


def follows(before: SampleBlock, after: SampleBlock) -> None:
    """Require that one block continues the other, or that the gap between them is counted."""
    end = before.tick + len(before.data)
    missing = after.sequence - before.sequence - 1
    require(missing >= 0, f"block {after.sequence} came after block {before.sequence}")
    require(
        after.tick >= end,
        f"block {after.sequence} begins at tick {after.tick}, before the end {end} of the one "
        "before it",
    )
    require(
        (missing > 0) == (after.tick > end),
        f"block {before.sequence} ends at tick {end}, block {after.sequence} begins at "
        f"{after.tick}: ticks and numbers state different gaps",
    )


def rows_of(block: SampleBlock, first: int, end: int | None = None) -> SampleBlock:
    """Return the rows [first, end) of a block."""
    rows = slice(first, end)
    return replace(
        block, tick=block.tick + first, data=block.data[rows], saturated=block.saturated[rows]
    )
