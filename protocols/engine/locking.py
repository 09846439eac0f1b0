"""Positioning of pistons, locking of joints, and verification by the measured piston.

The device's position law has a steady error where the valve needs a command to stop the piston
(spool offset, leakage, dead band); the host removes it by slow integral action. A lock at an end
stop is a steady push against it; a closed valve is zero volts at the piston's position. With a
spool offset or a leak the piston creeps at zero volts, and no constant command stops it: one step
of a 12-bit output is 0.8 mm/s on the seed bench. In that case the position loop stays active to
hold it.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.base import OFF, OutputLaw
from protocols.engine.session import Array, Session
from protocols.engine.settings import ENGINE
from protocols.engine.states import LockFailed, ProtocolAborted
from protocols.steps.parts import CLOSED, END_MAX, Place
from protocols.steps.plans import LockPlan

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlacementReading:
    """Mean piston [m], speed [m/s] and command [V] of one joint over a short time."""

    piston: float
    speed: float
    command: float


def placement(session: Session, joint: int, first: int, last: int) -> PlacementReading:
    """Return the mean motion of joint `joint` (0-based) over ticks [first, last).

    Speed is the difference of the means of the two halves over half the time: unlike the difference
    of the end samples it averages the sensor's noise.
    """
    piston = session.piston(joint, first, last)
    middle = len(piston) // 2
    speed = (_mean(piston[middle:]) - _mean(piston[:middle])) / (
        0.5 * max(len(piston), 1) / session.rate
    )
    return PlacementReading(_mean(piston), speed, _mean(session.command(joint, first, last)))


def _mean(samples: Array) -> float:
    """Return the mean of the samples that were not lost; NaN if all were."""
    valid = samples[np.isfinite(samples)]
    return float(np.mean(valid)) if len(valid) else math.nan


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
    """Move pistons to `targets` [m] by joint (0-based), within `tolerance` [m]; return nulls [V].

    The null is the command that kept the piston still while it was in place for `settle`
    seconds; the position laws stay in force. Raises ProtocolAborted after `place.timeout`.
    """
    biases = dict.fromkeys(targets, 0.0)
    session.apply({j: position_law(place, s, 0.0) for j, s in targets.items()})
    began, still_since = session.now, session.now
    ends: dict[int, deque[float]] = {j: deque(maxlen=ENGINE.swing_ends) for j in targets}
    while True:
        first = session.wait(ENGINE.look_seconds)
        readings = {j: placement(session, j, first, session.now) for j in targets}
        for j in targets:
            piston = session.piston(j, first, session.now)
            ends[j] += (float(np.fmin.reduce(piston)), float(np.fmax.reduce(piston)))
        outside = {j for j in targets if not _in_place(readings[j], targets[j], tolerance)}
        if outside:
            still_since = session.now
        elif session.now - still_since >= settle * session.rate:
            return {j: placement(session, j, still_since, session.now).command for j in targets}
        # Integrate only where the piston is at rest; others are still moving.
        stuck = {j for j in outside if abs(readings[j].speed) < ENGINE.rocking_speed}
        for j in stuck:
            error = targets[j] - readings[j].piston
            biases[j] += ENGINE.integral_share * place.position_gain * error
            biases[j] = float(np.clip(biases[j], -place.limit, place.limit))
        if stuck:
            session.apply({j: position_law(place, targets[j], biases[j]) for j in stuck})
        if session.now - began > place.timeout * session.rate:
            j = min(outside, default=min(targets))
            raise ProtocolAborted(
                f"{step}: joint {j + 1} did not reach its place within {place.timeout:g} s: "
                f"piston measured at {1e3 * readings[j].piston:.2f} mm "
                f"(moving {1e3 * readings[j].speed:.2f} mm/s), "
                f"expected {1e3 * targets[j]:.2f} mm +- {1e3 * tolerance:g} mm; "
                f"{_cause(ends[j], targets[j], place, tolerance)}"
            )


def _cause(ends: Sequence[float], target: float, place: Place, tolerance: float) -> str:
    """Return the likely cause of a piston that has not settled, from the ends of its motion."""
    known = [end for end in ends if math.isfinite(end)]
    low, high = min(known, default=target), max(known, default=target)
    if low < target - tolerance and high > target + tolerance:
        return (
            f"it swings from {1e3 * low:.2f} to {1e3 * high:.2f} mm about its place: lower "
            f"place.position_gain, {place.position_gain:g} V/m"
        )
    return "is the pump on, and the valve connected the right way round?"


def _in_place(reading: PlacementReading, target: float, tolerance: float) -> bool:
    return abs(reading.piston - target) <= tolerance and abs(reading.speed) <= ENGINE.rocking_speed


@dataclass(frozen=True)
class JointLock:
    """A locked joint (0-based): position [m], law, tolerance of its movement [m]."""

    joint: int
    at: str
    piston: float
    law: OutputLaw
    tolerance: float


@dataclass(frozen=True)
class Hold:
    """Data of a step for locking: name, time at rest, length of a record [s]."""

    step: str
    settle: float
    record: float


def lock(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Lock one joint as planned; raises LockFailed where the piston moves too much."""
    if plan.at == CLOSED:
        return close_valve(session, plan, place, hold)
    return push_to_end(session, plan, place, hold)


def push_to_end(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Drive a piston against its end stop and keep pushing.

    One law does both: far from the end the command is limited to `place.limit`, at the end only the
    push remains. The joint counts as locked when it is at rest within tolerance of the stroke's end
    for the time of `settle`. Raises LockFailed at `place.timeout`.
    """
    push = place.push if plan.at == END_MAX else -place.push
    session.apply({plan.joint: OutputLaw(0.0, push, place.position_gain, plan.piston, place.limit)})
    began, still_since = session.now, session.now
    while session.now - still_since < hold.settle * session.rate:
        reading = placement(session, plan.joint, session.wait(ENGINE.look_seconds), session.now)
        off = abs(reading.piston - plan.piston) > plan.tolerance
        if off or abs(reading.speed) > ENGINE.still_speed:
            still_since = session.now
        if session.now - began > place.timeout * session.rate:
            raise LockFailed(
                hold.step,
                plan.joint + 1,
                f"did not reach its end stop ({plan.at}) within {place.timeout:g} s",
                reading.piston,
                f"{1e3 * plan.piston:.2f} mm +- {1e3 * plan.tolerance:g} mm",
            )
    law = OutputLaw(bias=push, limit=abs(push))
    session.apply({plan.joint: law})
    first = session.wait(hold.settle)
    position = placement(session, plan.joint, first, session.now).piston
    held = JointLock(plan.joint, plan.at, position, law, plan.tolerance)
    verify(session, held, hold.step, first, session.now)
    log.info("%s: joint %d held at %s, %.2f mm", hold.step, plan.joint + 1, plan.at, 1e3 * position)
    return held


def close_valve(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Bring a piston to its place, close the valve, and verify that it stays.

    If it creeps by more than a quarter of the tolerance over a record, the position loop holds it
    instead. Raises LockFailed if that does not hold it either.
    """
    joint, target = plan.joint, {plan.joint: plan.piston}
    null = move(session, target, place, place.tolerance, hold.settle, hold.step)[joint]
    reading = _measure_at_rest(session, joint, OFF, hold)
    creep = abs(reading.speed) * hold.record
    log.info("%s: joint %d closed creeps %.3f mm/s", hold.step, joint + 1, 1e3 * reading.speed)
    if creep <= ENGINE.creep_share * plan.tolerance and _is_near(reading, plan):
        return JointLock(joint, plan.at, reading.piston, OFF, plan.tolerance)
    law = position_law(place, plan.piston, null)
    log.warning("%s: joint %d creeps with its valve closed; its position loop holds it",
                hold.step, joint + 1)  # fmt: skip
    move(session, target, place, place.tolerance, hold.settle, hold.step)
    reading = _measure_at_rest(session, joint, law, hold)
    if not _is_near(reading, plan):
        raise LockFailed(
            hold.step,
            joint + 1,
            "stays neither with its valve closed nor by its position loop",
            reading.piston,
            f"{1e3 * plan.piston:.2f} mm +- {1e3 * plan.tolerance:g} mm; does the valve leak?",
        )
    return JointLock(joint, plan.at, reading.piston, law, plan.tolerance)


def _measure_at_rest(session: Session, joint: int, law: OutputLaw, hold: Hold) -> PlacementReading:
    """Apply a law, wait until the pressures settle, and measure for the same time again."""
    session.apply({joint: law})
    session.wait(hold.settle)
    first = session.wait(hold.settle)
    return placement(session, joint, first, session.now)


def _is_near(reading: PlacementReading, plan: LockPlan) -> bool:
    return abs(reading.piston - plan.piston) <= 0.5 * plan.tolerance


def lock_movement(session: Session, held: JointLock, first: int, last: int) -> float:
    """Return the largest movement of a locked piston over ticks [first, last) [m]."""
    moved = np.abs(session.piston(held.joint, first, last) - held.piston)
    return float(np.fmax.reduce(moved, initial=0.0))


def verify(session: Session, held: JointLock, step: str, first: int, last: int) -> None:
    """Raise LockFailed if a locked piston moved by more than the tolerance."""
    piston = session.piston(held.joint, first, last)
    moved = np.abs(piston - held.piston)
    if np.count_nonzero(moved > held.tolerance):
        worst = float(piston[np.nanargmax(moved)])
        raise LockFailed(
            step,
            held.joint + 1,
            f"moved while locked ({held.at})",
            worst,
            f"{1e3 * held.piston:.2f} mm +- {1e3 * held.tolerance:g} mm",
        )
