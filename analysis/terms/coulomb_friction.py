"""Dry friction of one joint, the same in both directions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from analysis.signals import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    SD,
    TORQUE,
    Array,
    Coefficient,
    Columns,
    G,
    Kernel,
    Term,
    equation,
    kernel,
)
from rig.model.rig import Rig

# Speed of the transition through rest [m/s, or rad/s of a revolute electric joint]. A jump would
# make the integrator chatter where a joint sticks; this creeps by less than 0.1 mm/s there. On the
# measured positioning system 0.01 mm/s and 0.1 mm/s give the same parameters to 0.4 %, 1 mm/s does
# not (2 %).
TRANSITION: Final = 1e-4


@dataclass(frozen=True)
class CoulombFriction(Term):
    """Force Fc tanh(s'/v) against the motion, v = `TRANSITION`: torque G Fc tanh(s'/v).

    s is the piston (Fc in N); of an electric joint the joint itself, G = 1 (Fc in N or N m).
    """

    name: ClassVar[str] = "coulomb_friction"
    per_joint: ClassVar[bool] = True
    rate_tolerance: ClassVar[float] = 1e-3 * TRANSITION  # coarser, the creep at rest is noise
    where: str = "joint 1"

    @property
    def kernel(self) -> Kernel:
        """The compiled contribution."""
        return _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return Fc of the joint."""
        name = f"Fc{self.joint + 1}"
        unit = rig.unit_of_parameter(name) if rig.electric else "N"
        return (Coefficient(name, unit, "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G tanh(s'/v) in the row of the joint."""
        i = self.joint
        column = signals.G[:, i] * np.tanh(signals.sd[:, i] / TRANSITION)
        return {equation("torque", i): {f"Fc{i + 1}": column}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return Fc and the joint, 0-based."""
        return np.array([values[f"Fc{self.joint + 1}"], float(self.joint)])


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[1])
        out[TORQUE, i] -= par[0] * x[G, i] * math.tanh(x[SD, i] / TRANSITION)


TERMS = (CoulombFriction,)
