"""Where the spools should be: the commands put out, through the valves' own dynamics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from rig.model.rig import Rig

Array = NDArray[np.float64]


class ExpectedSpool:
    """Second-order response of every spool to its held command, sample after sample.

    y'' + 2 zeta w y' + w^2 y = w^2 spool_gain command, |y| <= spool_stroke, discretised exactly
    for an output held between samples; Merritt (1967), Hydraulic Control Systems, 6.3.
    """

    def __init__(self, rig: Rig) -> None:
        self._valves = [joint.valve for joint in rig.joints]
        self._filters = []
        for valve in self._valves:
            w = 2.0 * math.pi * valve.natural_frequency
            system = ([w * w], [1.0, 2.0 * valve.damping_ratio * w, w * w])
            b, a, _ = cont2discrete(system, 1.0 / rig.sample_rate)
            self._filters.append((b.ravel(), a))
        self._state: list[Array] | None = None

    def forget(self) -> None:
        """Begin anew with the spools at rest under the next command."""
        self._state = None

    def follow(self, commands: Array) -> Array:
        """Return the expected spools [V] under commands [V], both of shape (n, joints)."""
        out = np.empty_like(commands)
        fresh = self._state is None
        state = self._state or [np.zeros(2)] * len(self._filters)
        for j, ((b, a), valve) in enumerate(zip(self._filters, self._valves, strict=True)):
            stroke = valve.spool_stroke
            wanted = np.clip(valve.spool_gain * commands[:, j], -stroke, stroke)
            if fresh:  # at rest under the first command: z of a filter of unit gain
                z2 = (b[2] - a[2]) * wanted[0]
                state[j] = np.array([(b[1] - a[1]) * wanted[0] + z2, z2])
            out[:, j], state[j] = lfilter(b, a, wanted, zi=state[j])
        self._state = state
        return out
