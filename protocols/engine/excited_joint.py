"""One excited joint: its bias, its motion, and the correction of its bias."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np

from protocols.engine.centring import (
    Array,
    Motion,
    follow,
    forecast,
    leaves,
    motion,
    moved_by,
    recentring,
    trim,
)
from protocols.engine.settings import ENGINE
from protocols.engine.states import ProtocolAborted
from protocols.steps.parts import OPEN_LOOP, Centring
from protocols.steps.plans import ExcitePlan

log = logging.getLogger(__name__)

AT_REST = Motion(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ExcitedJoint:
    """An excited joint: its plan, bias [V], gain k [m/(s V)], target drift [m/s], motion."""

    plan: ExcitePlan
    bias: float
    gain: float = math.nan
    target: float = 0.0
    moved: Motion = AT_REST

    @property
    def joint(self) -> int:
        """The joint, 0-based."""
        return self.plan.joint

    @property
    def centring(self) -> Centring:
        """Its centring settings."""
        return self.plan.settings.centring

    @property
    def loop(self) -> float:
        """The position gain [V/m] while it is recorded; 0 in open loop."""
        return 0.0 if self.centring.mode == OPEN_LOOP else self.centring.position_gain


def found_under_loop(
    driven: ExcitedJoint, command: Array, piston: Array, period: int, rate: float, step: str
) -> ExcitedJoint:
    """Return the joint with gain and bias measured under the loop; arrays of shape (n,).

    The drift is exact over two whole periods, else from the fit of `follow`. Raises ProtocolAborted
    for a piston that does not follow its command.
    """
    response = follow(command, piston, rate)
    if not response.gain > 0.0:
        raise ProtocolAborted(
            f"{step}: joint {driven.joint + 1} does not follow its command: "
            f"{np.nanstd(command):.3g} V (rms) move the piston by {response.gain:.3g} m/s per "
            "volt, expected more than 0; is the pump on, and the valve connected the right way "
            "round?"
        )
    if len(piston) >= 2 * period:
        moved = motion(piston, period, rate)
        bias = float(np.nanmean(command[-period:])) - moved.drift / response.gain
    else:
        moved = moved_by(piston, response.drift, rate)
        bias = response.null
    log.info("%s: joint %d moves %.4f m/s per volt, null %.4f V", step, driven.joint + 1,
             response.gain, bias)  # fmt: skip
    return replace(driven, bias=bias, gain=response.gain, moved=moved)


def off_centre(driven: ExcitedJoint) -> float:
    """Return the offset of the piston from its centre, as a share of the allowed one."""
    return abs(driven.moved.ends - driven.plan.centre) / driven.centring.offset


def check_swing(
    driven: ExcitedJoint, period: Array, limits: tuple[float, float], step: str
) -> None:  # fmt: skip
    """Raise ProtocolAborted if a period (n,) of the piston has no room for its allowed offset."""
    swing = period - np.nanmean(period) + driven.plan.centre
    low, high = float(np.nanmin(swing)), float(np.nanmax(swing))
    spare = driven.centring.offset
    if low - spare < limits[0] or high + spare > limits[1]:
        raise ProtocolAborted(
            f"{step}: joint {driven.joint + 1} swings {1e3 * low:.1f} to {1e3 * high:.1f} mm; with "
            f"the {1e3 * spare:g} mm that its centre may be off, that leaves its limits, "
            f"{1e3 * limits[0]:g} to {1e3 * limits[1]:g} mm: lower the amplitude"
        )


def settled(driven: ExcitedJoint, moved: Motion, record: float, step: str) -> bool:
    """Return whether offset and drift over a record of `record` seconds are within limits."""
    offset = moved.ends - driven.plan.centre
    log.info(
        "%s: joint %d at bias %.4f V drifts %.3f mm/s (target %.3f), centre off by %.2f mm",
        step, driven.joint + 1, driven.bias, 1e3 * moved.drift, 1e3 * driven.target, 1e3 * offset,
    )  # fmt: skip
    error = abs(moved.drift - driven.target) * record
    return error <= driven.centring.drift and abs(offset) <= driven.centring.offset


def trimmed(driven: ExcitedJoint, moved: Motion, seconds: float, gently: bool) -> ExcitedJoint:
    """Return the joint with the bias for its next `seconds`; `gently` where that is a record."""
    if driven.loop > 0.0:
        # The loop's steady offset is what it adds to the bias: move it into the bias.
        offset = moved.mean - driven.plan.centre
        bias = driven.bias - driven.loop * offset - moved.drift / driven.gain
        return replace(driven, bias=bias, moved=moved)
    cap = ENGINE.recentre_cap * driven.centring.drift if gently else math.inf
    target = recentring(moved, driven.plan.centre, seconds, cap)
    bias = trim(driven.bias, moved.drift, target, driven.gain)
    return replace(driven, bias=bias, target=target, moved=moved)


def corrected(
    driven: ExcitedJoint,
    reference: Array,
    other_law: bool,
    samples: Array,
    horizon: int,
    rate: float,
    limits: tuple[float, float],
    step: str,
) -> ExcitedJoint | None:  # fmt: skip
    """Return the joint with a bias that keeps it within `limits` [m], None if none is needed.

    `reference`, `samples` and `horizon` are those of `forecast`; `other_law` states that the
    reference was measured under another law. The new bias centres the piston at the period's end.
    """
    if driven.loop > 0.0:
        return None
    # Under another law the reference has another shape, whose difference looks like a drift until a
    # whole period has passed; its own drift is also different.
    shortest = len(reference) if other_law else max(ENGINE.shortest_line, len(reference) // 10)
    expected = forecast(reference, samples, horizon, rate, shortest)
    if not leaves(expected, *limits):
        return None
    remaining = len(reference) - len(samples) % len(reference)
    offset = float(np.nanmean(reference)) + expected.shift - driven.plan.centre
    speed = -offset / max(ENGINE.shortest_return, remaining / rate)
    speed = float(np.clip(speed, -ENGINE.fastest_return, ENGINE.fastest_return))
    drift = expected.slope + (0.0 if other_law else driven.moved.drift)
    log.warning(
        "%s: joint %d would reach %.1f..%.1f mm; its bias is corrected at once",
        step, driven.joint + 1, 1e3 * expected.low, 1e3 * expected.high,
    )  # fmt: skip
    return replace(driven, bias=trim(driven.bias, drift, speed, driven.gain), target=speed)


def returned(driven: ExcitedJoint) -> ExcitedJoint:
    """Return the joint without the correction in its bias."""
    return replace(driven, bias=trim(driven.bias, driven.target, 0.0, driven.gain), target=0.0)


def not_centred(driven: ExcitedJoint, record: float, tries: int, step: str) -> ProtocolAborted:
    """Return the error of a joint whose bias did not settle."""
    allowed = driven.centring
    return ProtocolAborted(
        f"{step}: joint {driven.joint + 1} is not centred after {tries} trials: it drifts "
        f"{1e3 * driven.moved.drift * record:.2f} mm in a record (allowed "
        f"{1e3 * allowed.drift:g} mm) and its centre is at {1e3 * driven.moved.ends:.2f} mm "
        f"(expected {1e3 * driven.plan.centre:g} +- {1e3 * allowed.offset:g} mm); "
        "allow more drift, lower the amplitude, or centre by 'position-loop'"
    )
