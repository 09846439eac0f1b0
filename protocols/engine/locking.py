"""Locking a joint, and proving from the measured piston that it is locked.

A lock at an end stop is a steady push against it; a closed valve is zero volts where the piston
stands. With a spool offset or a leak the piston creeps at zero volts, and no steady command stops
it: one step of a 12-bit output is already 0.8 mm/s on the seed bench. There the position loop that
brought the piston to its place goes on holding it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from drivers.base import OFF, OutputLaw
from protocols.engine.placing import LOOK, STILL, PlacementReading, look, move, position_law
from protocols.engine.session import Session
from protocols.engine.states import LockFailed
from protocols.steps.parts import CLOSED, END_MAX, Place
from protocols.steps.plans import LockPlan

log = logging.getLogger(__name__)

CREEP_SHARE = 0.25  # of the tolerance, that a closed joint may creep during one record


@dataclass(frozen=True)
class JointLock:
    """A joint (0-based) that is locked: where [m], by which law, how far it may give [m]."""

    joint: int
    at: str
    piston: float
    law: OutputLaw
    tolerance: float


@dataclass(frozen=True)
class Hold:
    """What locking needs to know of its step: name, time at rest, length of a record [s]."""

    step: str
    settle: float
    record: float


def lock(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Lock one joint as planned; raises LockFailed where the piston does not prove it."""
    if plan.at == CLOSED:
        return close_valve(session, plan, place, hold)
    return push_to_end(session, plan, place, hold)


def push_to_end(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Drive a piston against its end stop and keep pushing.

    One law does both: far from the end the position gain drives at `place.limit`, at the end
    only the push is left of it. Locked is: within tolerance of the stroke's end and still, for
    the time of `settle`. Raises LockFailed at `place.timeout`.
    """
    push = place.push if plan.at == END_MAX else -place.push
    session.apply({plan.joint: OutputLaw(0.0, push, place.position_gain, plan.piston, place.limit)})
    began, still_since = session.now, session.now
    while session.now - still_since < hold.settle * session.rate:
        seen = look(session, plan.joint, session.wait(LOOK), session.now)
        if abs(seen.piston - plan.piston) > plan.tolerance or abs(seen.speed) > STILL:
            still_since = session.now
        if session.now - began > place.timeout * session.rate:
            raise LockFailed(
                hold.step,
                plan.joint + 1,
                f"did not reach its end stop ({plan.at}) within {place.timeout:g} s",
                seen.piston,
                f"{1e3 * plan.piston:.2f} mm +- {1e3 * plan.tolerance:g} mm",
            )
    law = OutputLaw(bias=push, limit=abs(push))
    session.apply({plan.joint: law})
    first = session.wait(hold.settle)
    stands = look(session, plan.joint, first, session.now).piston
    held = JointLock(plan.joint, plan.at, stands, law, plan.tolerance)
    verify(session, held, hold.step, first, session.now)
    log.info("%s: joint %d held at %s, %.2f mm", hold.step, plan.joint + 1, plan.at, 1e3 * stands)
    return held


def close_valve(session: Session, plan: LockPlan, place: Place, hold: Hold) -> JointLock:
    """Bring a piston to its place, close the valve there, and watch that it stays.

    If it creeps so that more than a quarter of the tolerance were gone by the end of a record,
    the position loop holds it instead. Raises LockFailed if that does not keep it either.
    """
    joint, target = plan.joint, {plan.joint: plan.piston}
    null = move(session, target, place, place.tolerance, hold.settle, hold.step)[joint]
    seen = _stand(session, joint, OFF, hold)
    creep = abs(seen.speed) * hold.record
    log.info("%s: joint %d closed creeps %.3f mm/s", hold.step, joint + 1, 1e3 * seen.speed)
    if creep <= CREEP_SHARE * plan.tolerance and _near(seen, plan):
        return JointLock(joint, plan.at, seen.piston, OFF, plan.tolerance)
    law = position_law(place, plan.piston, null)
    log.warning("%s: joint %d creeps with its valve closed; its position loop holds it",
                hold.step, joint + 1)  # fmt: skip
    move(session, target, place, place.tolerance, hold.settle, hold.step)
    seen = _stand(session, joint, law, hold)
    if not _near(seen, plan):
        raise LockFailed(
            hold.step,
            joint + 1,
            "stays neither with its valve closed nor by its position loop",
            seen.piston,
            f"{1e3 * plan.piston:.2f} mm +- {1e3 * plan.tolerance:g} mm; does the valve leak?",
        )
    return JointLock(joint, plan.at, seen.piston, law, plan.tolerance)


def _stand(session: Session, joint: int, law: OutputLaw, hold: Hold) -> PlacementReading:
    """Put a law in force, let the pressures find their balance, and look for as long again."""
    session.apply({joint: law})
    session.wait(hold.settle)
    first = session.wait(hold.settle)
    return look(session, joint, first, session.now)


def _near(seen: PlacementReading, plan: LockPlan) -> bool:
    return abs(seen.piston - plan.piston) <= 0.5 * plan.tolerance


def give(session: Session, held: JointLock, first: int, last: int) -> float:
    """Return how far a locked piston left its place over ticks [first, last) at most [m]."""
    moved = np.abs(session.piston(held.joint, first, last) - held.piston)
    return float(np.nanmax(moved, initial=0.0))


def verify(session: Session, held: JointLock, step: str, first: int, last: int) -> None:
    """Raise LockFailed if a locked piston left its place by more than the tolerance."""
    piston = session.piston(held.joint, first, last)
    moved = np.abs(piston - held.piston)
    if np.any(moved > held.tolerance):
        worst = float(piston[np.nanargmax(moved)])
        raise LockFailed(
            step,
            held.joint + 1,
            f"moved while locked ({held.at})",
            worst,
            f"{1e3 * held.piston:.2f} mm +- {1e3 * held.tolerance:g} mm",
        )
