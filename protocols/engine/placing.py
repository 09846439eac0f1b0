"""Bringing pistons to a place and holding them there, before anything is excited.

The device's position law leaves an error where the valve needs a command to stand still (spool
offset, leakage, dead band): here the host integrates that error away, slowly.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.base import OutputLaw
from protocols.engine.session import Session
from protocols.engine.states import ProtocolAborted
from protocols.steps.parts import Place

log = logging.getLogger(__name__)

LOOK = 0.1  # [s] of samples behind one mean: noise of 10 um becomes 1 um
STILL = 1e-3  # [m/s] a piston slower than this stands, against an end stop
# One step of a coarse output is worth about 1 mm/s: in a loop a piston rocks by that for ever.
ROCKING = 3e-3  # [m/s]
INTEGRAL = 0.5  # share of the remaining error that one look takes out


@dataclass(frozen=True)
class PlacementReading:
    """Mean piston [m], speed [m/s] and command [V] of one joint over a short time."""

    piston: float
    speed: float
    command: float


def look(session: Session, joint: int, first: int, last: int) -> PlacementReading:
    """Return what joint `joint` (0-based) did over ticks [first, last).

    Speed is the difference of the means of the two halves over half the time: unlike the
    difference of the end samples it averages the sensor's noise.
    """
    piston = session.piston(joint, first, last)
    middle = len(piston) // 2
    early, late = np.nanmean(piston[:middle]), np.nanmean(piston[middle:])
    speed = (late - early) / (0.5 * len(piston) / session.rate)
    command = np.nanmean(session.command(joint, first, last))
    return PlacementReading(float(np.nanmean(piston)), float(speed), float(command))


def position_law(place: Place, target: float, bias: float) -> OutputLaw:
    """Return the law that brings a piston to `target` [m] with at most `place.limit` volts."""
    return OutputLaw(
        bias=bias, position_gain=place.position_gain, setpoint=target, limit=place.limit
    )


def move(
    session: Session,
    targets: Mapping[int, float],
    place: Place,
    tolerance: float,
    settle: float,
    step: str,
) -> dict[int, float]:
    """Bring joints (0-based) to their places +- tolerance [m], hold them; returns their nulls [V].

    The null is the command that kept the piston still while it was in place for `settle`
    seconds; the position laws stay in force. Raises ProtocolAborted after `place.timeout`.
    """
    biases = dict.fromkeys(targets, 0.0)
    session.apply({j: position_law(place, s, 0.0) for j, s in targets.items()})
    began, still_since = session.now, session.now
    while True:
        first = session.wait(LOOK)
        seen = {j: look(session, j, first, session.now) for j in targets}
        late = {j for j in targets if not _in_place(seen[j], targets[j], tolerance)}
        if late:
            still_since = session.now
        elif session.now - still_since >= settle * session.rate:
            return {j: look(session, j, still_since, session.now).command for j in targets}
        # Only what no longer moves is off for want of a command; the rest is still on its way.
        stuck = {j for j in late if abs(seen[j].speed) < ROCKING}
        for j in stuck:
            biases[j] += INTEGRAL * place.position_gain * (targets[j] - seen[j].piston)
            biases[j] = float(np.clip(biases[j], -place.limit, place.limit))
        if stuck:
            session.apply({j: position_law(place, targets[j], biases[j]) for j in stuck})
        if session.now - began > place.timeout * session.rate:
            j = min(late, default=min(targets))
            raise ProtocolAborted(
                f"{step}: joint {j + 1} did not reach its place within {place.timeout:g} s: "
                f"piston measured at {1e3 * seen[j].piston:.2f} mm "
                f"(moving {1e3 * seen[j].speed:.2f} mm/s), "
                f"expected {1e3 * targets[j]:.2f} mm +- {1e3 * tolerance:g} mm; "
                "is the pump on, and the valve connected the right way round?"
            )


def _in_place(seen: PlacementReading, target: float, tolerance: float) -> bool:
    return abs(seen.piston - target) <= tolerance and abs(seen.speed) <= ROCKING
