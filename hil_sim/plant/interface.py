"""The plant as the device uses it: output laws, and samples that are computed ahead.

In virtual time the next block almost always has the same laws, so that it is computed while the
host works on the previous one. If the laws change, the plant is rewound before it runs, so that
results do not depend on this.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rig.model.wire.codes import Array, Codes


@dataclass(frozen=True)
class Law:
    """The output law of one joint; all zeros closes the valve.

    v = clip(gain wave[(tick - start) mod period] + bias + position_gain (setpoint - s), +-limit)
    [V], s the piston as measured at that tick [m]; an empty wave adds nothing.
    """

    wave: Array = field(default_factory=lambda: np.zeros(0))
    start: int = 0
    gain: float = 0.0
    bias: float = 0.0
    position_gain: float = 0.0
    setpoint: float = 0.0
    limit: float = 0.0


class PlantInterface(Protocol):
    """A plant, deterministic, with all physical state."""

    @property
    def tick(self) -> int:
        """Samples measured so far."""

    def advance(self, ticks: int, laws: Sequence[Any]) -> tuple[Codes, Codes]:
        """Run `ticks` samples; return AD codes (ticks, channels), DA codes (ticks, joints)."""


@runtime_checkable
class Rewindable(PlantInterface, Protocol):
    """A plant with a state that can be restored."""

    def mark(self) -> object | None:
        """Return the state for `rewind`; None if it cannot be restored."""

    def rewind(self, mark: object) -> None:
        """Restore the state of a mark."""


class Prefetch:
    """A plant with the block that is probably requested next."""

    def __init__(self, plant: Rewindable) -> None:
        self._plant = plant
        self._mark: object | None = None
        self._laws: tuple[Any, ...] = ()
        self._block: tuple[Codes, Codes] | None = None

    @property
    def tick(self) -> int:
        """Samples measured so far, without those computed ahead."""
        return self._plant.tick - (0 if self._block is None else len(self._block[0]))

    def prefetch(self, ticks: int, laws: Sequence[Any]) -> None:
        """Compute the next `ticks` samples under `laws`, unless done already or impossible."""
        if self._block is not None:
            if self._holds(laws):
                return
            self._block = None
            self._plant.rewind(self._mark)
        if (mark := self._plant.mark()) is None:
            return
        try:
            ahead = self._plant.advance(ticks, laws)
        except Exception:  # raised again when the samples are requested
            self._plant.rewind(mark)
            return
        self._mark, self._laws, self._block = mark, tuple(laws), ahead

    def advance(self, ticks: int, laws: Sequence[Any]) -> tuple[Codes, Codes]:
        """Run `ticks` samples as the plant does."""
        ahead, self._block = self._block, None
        if ahead is not None:
            if len(ahead[0]) == ticks and self._holds(laws):
                return ahead
            self._plant.rewind(self._mark)
        return self._plant.advance(ticks, laws)

    def _holds(self, laws: Sequence[Any]) -> bool:
        """Return whether the block ahead was computed under these laws."""
        return len(laws) == len(self._laws) and all(map(operator.is_, laws, self._laws))
