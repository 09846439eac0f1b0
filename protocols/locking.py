"""Locking a joint, and proving from the measured piston that it is locked.

A lock at an end stop is a steady push against it; a closed valve is the command at which the
piston stands still. That command is zero on a perfect valve. With a spool offset or a leak it is
not, and a joint "locked" at zero volts would creep: so zero is tried, and the null used where
zero creeps.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from drivers.base import OutputLaw
from protocols.errors import LockFailed
from protocols.model import CLOSED, END_MAX, Place
from protocols.placing import LOOK, STILL, look, move
from protocols.plan import LockPlan
from protocols.session import Session

log = logging.getLogger(__name__)

CREEP_SHARE = 0.25  # of the tolerance, that a closed joint may creep during one record
NULL_TRIES = 4


@dataclass(frozen=True)
class Lock:
    """A joint (0-based) that is locked: where [m], with which command [V], how far it may give."""

    joint: int
    at: str
    piston: float
    command: float
    tolerance: float


@dataclass(frozen=True)
class Hold:
    """What locking needs to know of its step: name, time at rest, length of a record [s]."""

    step: str
    settle: float
    record: float


def lock(session: Session, plan: LockPlan, place: Place, hold: Hold) -> Lock:
    """Lock one joint as planned; raises LockFailed where the piston does not prove it."""
    if plan.at == CLOSED:
        return close_valve(session, plan, place, hold)
    return push_to_end(session, plan, place, hold)


def push_to_end(session: Session, plan: LockPlan, place: Place, hold: Hold) -> Lock:
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
    session.apply({plan.joint: OutputLaw(bias=push, limit=abs(push))})
    first = session.wait(hold.settle)
    stands = look(session, plan.joint, first, session.now).piston
    held = Lock(plan.joint, plan.at, stands, push, plan.tolerance)
    verify(session, held, hold.step, first, session.now)
    log.info("%s: joint %d held at %s, %.2f mm", hold.step, plan.joint + 1, plan.at, 1e3 * stands)
    return held


def close_valve(session: Session, plan: LockPlan, place: Place, hold: Hold) -> Lock:
    """Bring a piston to its place, close the valve there, and watch that it stays.

    The creep of the last half of `settle` must not take more than a quarter of the tolerance in
    a record. If it does at zero volts, the null of the position loop is tried, then corrected by
    the secant of creep against command. Raises LockFailed after `NULL_TRIES`.
    """
    joint = plan.joint
    allowed = CREEP_SHARE * plan.tolerance / hold.record
    tried: list[tuple[float, float]] = []
    command = 0.0
    for _ in range(NULL_TRIES):
        null = move(session, {joint: plan.piston}, place, hold.settle, hold.step)[joint]
        command = _next_command(tried, null)
        session.apply({joint: OutputLaw(bias=command, limit=abs(command))})
        session.wait(0.5 * hold.settle)  # the pressures find their balance first
        first = session.wait(hold.settle)
        seen = look(session, joint, first, session.now)
        near = abs(seen.piston - plan.piston) <= plan.tolerance
        log.info("%s: joint %d closed at %.4f V creeps %.4f mm/s", hold.step, joint + 1, command,
                 1e3 * seen.speed)  # fmt: skip
        if abs(seen.speed) <= allowed and near:
            return Lock(joint, plan.at, seen.piston, command, plan.tolerance)
        tried.append((command, seen.speed))
    raise LockFailed(
        hold.step,
        joint + 1,
        f"creeps {1e3 * seen.speed:.3f} mm/s with its valve closed (command {command:.4f} V)",
        seen.piston,
        f"{1e3 * plan.piston:.2f} mm, creeping less than {1e3 * allowed:.3f} mm/s; "
        "does the valve leak?",
    )


def _next_command(tried: list[tuple[float, float]], null: float) -> float:
    if not tried:
        return 0.0
    if len(tried) == 1:
        return null
    (v0, r0), (v1, r1) = tried[-2:]
    return null if abs(r1 - r0) < 1e-9 else v1 - r1 * (v1 - v0) / (r1 - r0)


def give(session: Session, held: Lock, first: int, last: int) -> float:
    """Return how far a locked piston left its place over ticks [first, last) at most [m]."""
    moved = np.abs(session.piston(held.joint, first, last) - held.piston)
    return float(np.nanmax(moved, initial=0.0))


def verify(session: Session, held: Lock, step: str, first: int, last: int) -> None:
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
