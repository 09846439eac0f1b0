"""The role of each joint, and the bounds of its piston."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rig.model.rig import Rig

_STROKE_MARGIN = 0.02  # share of the stroke: compliance of the end stop and offset of the sensor


@dataclass(frozen=True)
class JointRole:
    """The present role of a joint.

    The piston of an `excited` joint must stay within `limits.piston`; any other may reach the ends
    of its stroke, also that of a `jogged` one, which a person moves. A locked piston must stay
    within `tolerance` [m] of `locked_at` [m].
    """

    excited: bool = False
    jogged: bool = False
    locked_at: float | None = None
    tolerance: float = math.inf

    @property
    def driven(self) -> bool:
        """Whether a command moves the joint, of a protocol or of a person."""
        return self.excited or self.jogged

    @property
    def locked(self) -> bool:
        """Whether the joint is locked."""
        return self.locked_at is not None and math.isfinite(self.tolerance)


FREE = JointRole()
EXCITED = JointRole(excited=True)
JOGGED = JointRole(jogged=True)


def piston_bounds(role: JointRole, rig: Rig, joint: int) -> tuple[str, float, float]:
    """Return (name of the limit, lowest, highest [m]) of a joint's piston in its role."""
    part = rig.joints[joint]
    if role.locked_at is not None and role.locked:
        return "lock", role.locked_at - role.tolerance, role.locked_at + role.tolerance
    if role.excited:
        return "piston", *part.limits.piston
    reach = part.cylinder.stroke * (0.5 + _STROKE_MARGIN)
    return "stroke end", -reach, reach
