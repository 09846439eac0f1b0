"""Sensors that keep one value while their joint moves.

A sensor is *frozen* when an excited joint's channel keeps one value over `frozen_after` while that
joint's command and another of its channels move. This cannot be a slow signal on a coarse
converter: only sensors whose stated noise is a code or more are judged. Even at rest, two samples
in a row of such a sensor read the same code with a probability of at most q / (2 sigma sqrt(pi)) <
0.29 (q: one code), 250 of them with 0.29^249. Noise four times smaller than stated would still need
a pressure or position constant to a code while the joint moves. In a jog the command is constant
and nothing else need change: there the position alone is judged. A sensor at an end of its range is
left to the check for saturation.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.rig import Rig

Array = NDArray[np.float64]

SWING: Final = 0.05  # share of the command's limit, peak to peak, that moves a joint
HELD: Final = 0.01  # share of the command's limit that, kept up in a jog, moves a joint
_MOVED = 12.0  # standard deviations, peak to peak: noise alone reaches some 7 in 250 samples


class Frozen:
    """Finds a channel of one joint (0-based) that stays constant while the joint moves."""

    def __init__(self, rig: Rig, joint: int) -> None:
        own = [(c, *ch.kind_of(name)) for c, name in enumerate(rig.channels)]
        parts = [(c, rig.sensors.of(kind)) for c, kind, which in own if which == joint + 1]
        self._columns = np.array([column for column, _ in parts])
        codes = np.array([np.ptp(s.range) / ((1 << s.bits) - 1) for _, s in parts])
        noise = np.array([s.noise for _, s in parts])
        self._judged = noise >= codes
        self.judged = np.zeros(len(rig.recorded), dtype=bool)  # of all that is recorded
        self.judged[self._columns[self._judged]] = True
        self._moved = _MOVED * np.maximum(noise, codes)
        self._low = np.array([s.range[0] for _, s in parts]) + codes
        self._high = np.array([s.range[1] for _, s in parts]) - codes
        self._command = rig.recorded.index(ch.channel(ch.COMMAND, joint + 1))
        self._swing = SWING * rig.joints[joint].limits.command
        self._held = HELD * rig.joints[joint].limits.command
        self._position = np.array(
            [kind == rig.position_kind for _, kind, i in own if i == joint + 1]
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
        elif np.ptp(command) < self._swing or not (np.ptp(values, axis=0) > self._moved).any():
            return None
        return int(self._columns[np.argmax(still)]) if still.any() else None
