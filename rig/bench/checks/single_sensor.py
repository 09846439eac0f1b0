"""Sensors that keep one value while their joint moves, or that stay at an end of their range.

A sensor is *frozen* when an excited joint's channel keeps one value over `frozen_after` while that
joint's command and another of its channels move. This cannot be a slow signal on a coarse
converter: only sensors whose stated noise is a code or more are judged. Even at rest, two samples
in a row of such a sensor read the same code with a probability of at most q / (2 sigma sqrt(pi)) <
0.29 (q: one code), 250 of them with 0.29^249. Noise four times smaller than stated would still need
a pressure or position constant to a code while the joint moves. In a jog the command is constant
and nothing else need change: there the position alone is judged.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.checks.bands import Counts, first_of, run_lengths
from rig.bench.settings import GuardSettings
from rig.model import channels as ch
from rig.model.parts import converter_step
from rig.model.rig import Rig
from rig.model.trips import SATURATED, Violation

Array = NDArray[np.float64]

SWING: Final = 0.05  # share of the command's limit, peak to peak, that moves a joint
HELD: Final = 0.01  # share of the command's limit that, kept up in a jog, moves a joint
_MOVES = 12.0  # standard deviations, peak to peak: noise alone reaches some 7 in 250 samples

_VACUUM = -90e3  # no gauge pressure is far below this, so such a range cannot be exceeded


class Frozen:
    """Finds a channel of one joint (0-based) that stays constant while the joint moves."""

    def __init__(self, rig: Rig, joint: int) -> None:
        measured = [(c, *ch.kind_of(name)) for c, name in enumerate(rig.channels)]
        parts = [(c, rig.sensors.of(kind)) for c, kind, number in measured if number == joint + 1]
        self._columns = np.array([column for column, _ in parts])
        codes = np.array([converter_step(s) for _, s in parts])
        noise = np.array([s.noise for _, s in parts])
        self._judged = noise >= codes
        self.judged = np.zeros(len(rig.recorded), dtype=bool)  # of all that is recorded
        self.judged[self._columns[self._judged]] = True
        self._moves_by = _MOVES * np.maximum(noise, codes)
        self._low = np.array([s.range[0] for _, s in parts]) + codes
        self._high = np.array([s.range[1] for _, s in parts]) - codes
        self._command = rig.recorded.index(ch.channel(ch.COMMAND, joint + 1))
        self._swing = SWING * rig.joints[joint].limits.command
        self._held = HELD * rig.joints[joint].limits.command
        self._position = np.array(
            [kind == rig.position_kind for _, kind, i in measured if i == joint + 1]
        )

    def find(self, window: Array, jogged: bool = False) -> int | None:
        """Return the column that kept one value over a window of samples, None if none did."""
        values = window[:, self._columns]
        still = (values == values[0]).all(axis=0) & self._judged
        still &= (values[0] > self._low) & (values[0] < self._high)
        if not still.any():
            return None
        command = window[:, self._command]
        if jogged:
            still &= self._position & (max(command.min(), -command.max()) >= self._held)
        elif np.ptp(command) < self._swing or not (np.ptp(values, axis=0) > self._moves_by).any():
            return None
        return int(self._columns[np.argmax(still)]) if still.any() else None


class Saturation:
    """Finds channels whose samples stay at an end of their range, across blocks."""

    def __init__(self, rig: Rig, settings: GuardSettings) -> None:
        self._rig = rig
        counts, middles = [], []
        for name in rig.channels:
            kind, _ = ch.kind_of(name)
            low, high = rig.sensors.of(kind).range
            vacuum = kind in (ch.CAP, ch.ROD) and low <= _VACUUM
            usual = settings.saturated_samples
            counts.append((usual, settings.saturated_samples_vacuum if vacuum else usual))
            middles.append((low + high) / 2)
        self._at_high, self._at_low = np.array(counts).T
        self._middles = np.array(middles)
        self.forget()

    def forget(self) -> None:
        """Reset: the next samples do not continue the previous ones."""
        self._runs: Counts = np.zeros(len(self._middles), dtype=np.int64)
        self._any = False  # a channel was at an end in the latest block

    def find(self, block: SampleBlock) -> list[Violation]:
        """Return the violation of the first channel too long at an end; empty if there is none."""
        if not np.count_nonzero(block.saturated):
            if self._any:
                self.forget()
            return []
        runs = run_lengths(block.saturated, self._runs)
        self._runs, self._any = runs[-1], True
        measured = block.data[:, : runs.shape[1]]
        too_long = runs >= np.where(measured > self._middles, self._at_high, self._at_low)
        if not too_long.any():
            return []
        row, column = first_of(too_long)
        name = self._rig.channels[column]
        kind, joint = ch.kind_of(name)
        ends = self._rig.sensors.of(kind).range
        value = float(measured[row, column])
        tick = block.tick + row
        return [Violation(SATURATED, value, ends, ch.unit_of(name), joint, name, tick)]
