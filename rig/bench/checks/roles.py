"""What each joint does now, and the piston's bounds that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rig.model.rig import Rig

_STROKE_MARGIN = 0.02  # of the stroke: give of the end stop and offset of the sensor


@dataclass(frozen=True)
class JointRole:
    """What one joint does now.

    An `excited` joint keeps `limits.piston`; any other may touch the ends of its stroke. A locked
    one has `locked_at` [m] and may leave it by `tolerance` [m] at most.
    """

    excited: bool = False
    locked_at: float | None = None
    tolerance: float = math.inf

    @property
    def locked(self) -> bool:
        """Whether the joint is held in its place."""
        return self.locked_at is not None and math.isfinite(self.tolerance)


FREE = JointRole()
EXCITED = JointRole(excited=True)


def piston_bounds(role: JointRole, rig: Rig, joint: int) -> tuple[str, float, float]:
    """Return (name of the limit, lowest, highest) of a joint's piston in its role."""
    part = rig.joints[joint]
    if role.locked_at is not None and role.locked:
        return "lock", role.locked_at - role.tolerance, role.locked_at + role.tolerance
    if role.excited:
        return "piston", *part.limits.piston
    reach = part.cylinder.stroke * (0.5 + _STROKE_MARGIN)
    return "stroke end", -reach, reach
