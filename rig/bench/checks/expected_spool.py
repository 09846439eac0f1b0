"""Expected spool positions: the commands filtered by the valves' dynamics."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.model.numerics.exponential import exponential
from rig.model.rig import Rig

Array = NDArray[np.float64]
_AT_ONCE: Final = 128  # samples


class ExpectedSpool:
    """Second-order response of every spool to its command, sample by sample.

    y'' + 2 zeta w y' + w^2 y = w^2 spool_gain command, |y| <= spool_stroke, discretised exactly
    for an output held between samples; Merritt (1967), Hydraulic Control Systems, 6.3.
    """

    def __init__(self, rig: Rig) -> None:
        valves = [joint.valve for joint in rig.joints]
        self._gain = np.array([[valve.spool_gain] for valve in valves])
        self._stroke = np.array([[valve.spool_stroke] for valve in valves])
        self._maps = []
        for valve in valves:
            w = 2.0 * math.pi * valve.natural_frequency
            damping = 2.0 * valve.damping_ratio * w
            system = np.array([[0.0, 1.0, 0.0], [-w * w, -damping, w * w], [0.0, 0.0, 0.0]])
            self._maps.append(_maps(exponential(system / rig.sample_rate)[:2]))
        self.forget()

    def forget(self) -> None:
        """Reset: the spools are at rest under the next command."""
        self._states: list[Array] = []  # of each spool: position, speed

    def follow(self, commands: Array) -> Array:
        """Return the expected spools [V] under commands [V], both of shape (joints, n).

        The spool at a sample follows from the commands up to the sample before.
        """
        targets = np.minimum(np.maximum(self._gain * commands, -self._stroke), self._stroke)
        # At rest under the first command.
        self._states = self._states or [np.array([row[0], 0.0]) for row in targets]
        out = np.empty_like(commands)
        for start in range(0, commands.shape[1], _AT_ONCE):
            for j, maps in enumerate(self._maps):
                inputs = targets[j][start : start + _AT_ONCE]
                n = len(inputs)
                state_and_inputs = np.concatenate((self._states[j], inputs))
                out[j, start : start + n] = maps[:n, 0, : n + 2] @ state_and_inputs
                self._states[j] = maps[n, :, : n + 2] @ state_and_inputs
        return out


def _maps(step: Array) -> Array:
    """Return the maps from state and inputs to the state after 0 to `_AT_ONCE` samples.

    The state is position and speed; `step` (2, 3) is the map of one sample. Shape
    (_AT_ONCE + 1, 2, 2 + _AT_ONCE).
    """
    maps = np.zeros((_AT_ONCE + 1, 2, 2 + _AT_ONCE))
    maps[0, :, :2] = np.eye(2)
    for k in range(_AT_ONCE):
        maps[k + 1] = step[:, :2] @ maps[k]
        maps[k + 1, :, 2 + k] = step[:, 2]
    return maps
