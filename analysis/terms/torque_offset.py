"""A constant torque or force on one joint: drive offset, unbalance, friction's asymmetry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from analysis.signals import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    TORQUE,
    Array,
    Coefficient,
    Columns,
    Kernel,
    Term,
    equation,
    kernel,
)
from rig.model.rig import Rig


@dataclass(frozen=True)
class TorqueOffset(Term):
    """M(q) q'' + ... + offset = torque (or force) of the joint."""

    name: ClassVar[str] = "torque_offset"
    per_joint: ClassVar[bool] = True
    where: str = "joint 1"

    @property
    def kernel(self) -> Kernel:
        """The compiled contribution."""
        return _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the offset of the joint [N m, or N of a prismatic joint]."""
        name = f"offset{self.joint + 1}"
        unit = rig.unit_of_parameter(name) if rig.electric else "N*m"
        return (Coefficient(name, unit, "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return ones in the row of the joint."""
        name = f"offset{self.joint + 1}"
        return {equation("torque", self.joint): {name: np.ones(len(signals.t))}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the offset and the joint, 0-based."""
        return np.array([values[f"offset{self.joint + 1}"], float(self.joint)])


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        out[TORQUE, int(par[1])] -= par[0]


TERMS = (TorqueOffset,)
