"""Base parameters of a planar chain from the bodies that make it up.

For bodies whose centres of mass lie on their link's line (NOTES, "N DOF planar chain"):
 W_k  = m_k c_k + l_k sum_{j>k} m_j
 R_kk = I_k + m_k c_k^2 + l_k^2 sum_{j>k} m_j,   R_ij = l_i W_j  (i < j)
with c_k from joint k to the centre of mass and I_k about it. For two joints M1 = R11 + R22 and
M2 = R22; for one M1 = R11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rig.model.parameters import inertia_names


@dataclass(frozen=True)
class Body:
    """A link: length, mass, centre of mass from its joint along the link, inertia about it; SI."""

    length: float
    mass: float
    centre: float
    inertia: float


def chain_parameters(bodies: Sequence[Body]) -> dict[str, float]:
    """Return the inertia parameters [kg m^2] and W_i [kg m] of a chain, base outwards."""
    N = len(bodies)
    beyond = [sum(body.mass for body in bodies[k + 1 :]) for k in range(N)]
    W = [b.mass * b.centre + b.length * m for b, m in zip(bodies, beyond, strict=True)]
    R = [[bodies[i].length * W[j] for j in range(N)] for i in range(N)]
    for k, body in enumerate(bodies):
        R[k][k] = body.inertia + body.mass * body.centre**2 + body.length**2 * beyond[k]
    values = [R[i][j] for i in range(N) for j in range(i, N)]
    if N == 2:
        values = [R[0][0] + R[1][1], R[1][1], R[0][1]]
    named = dict(zip(inertia_names(N), values, strict=True))
    return named | {f"W{k + 1}": W[k] for k in range(N)}
