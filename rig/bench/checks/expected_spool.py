"""Where the spools should be: the commands put out, through the valves' own dynamics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rig.model.rig import Rig

Array = NDArray[np.float64]
_SQUARINGS, _TERMS = 10, 8  # of the series for the matrix exponential: exact to rounding below w dt


class ExpectedSpool:
    """Second-order response of every spool to its held command, sample after sample.

    y'' + 2 zeta w y' + w^2 y = w^2 spool_gain command, |y| <= spool_stroke, discretised exactly
    for an output held between samples; Merritt (1967), Hydraulic Control Systems, 6.3.
    """

    def __init__(self, rig: Rig) -> None:
        self._valves = [joint.valve for joint in rig.joints]
        self._steps = []
        for valve in self._valves:
            w = 2.0 * math.pi * valve.natural_frequency
            damping = 2.0 * valve.damping_ratio * w
            system = np.array([[0.0, 1.0, 0.0], [-w * w, -damping, w * w], [0.0, 0.0, 0.0]])
            self._steps.append(_exponential(system / rig.sample_rate)[:2].tolist())
        self._state: list[tuple[float, float]] | None = None

    def forget(self) -> None:
        """Begin anew with the spools at rest under the next command."""
        self._state = None

    def follow(self, commands: Array) -> Array:
        """Return the expected spools [V] under commands [V], both of shape (n, joints).

        The spool at a sample follows from the commands up to the sample before.
        """
        out = np.empty_like(commands)
        after = []
        for j, (step, valve) in enumerate(zip(self._steps, self._valves, strict=True)):
            stroke = valve.spool_stroke
            wanted = np.clip(valve.spool_gain * commands[:, j], -stroke, stroke).tolist()
            # At rest under the first command.
            place, speed = self._state[j] if self._state else (wanted[0], 0.0)
            (pp, ps, pu), (sp, ss, su) = step
            places = []
            for u in wanted:
                places.append(place)
                place, speed = pp * place + ps * speed + pu * u, sp * place + ss * speed + su * u
            out[:, j] = places
            after.append((place, speed))
        self._state = after
        return out


def _exponential(matrix: Array) -> Array:
    """Return exp(matrix) by scaling and squaring; scipy has it too and loads slowly."""
    small = matrix / 2.0**_SQUARINGS
    term = total = np.eye(len(matrix))
    for n in range(1, _TERMS):
        term = term @ small / n
        total = total + term
    for _ in range(_SQUARINGS):
        total = total @ total
    return total
