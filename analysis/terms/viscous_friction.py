"""Viscous friction of every joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    QD,
    TORQUE,
    Coefficient,
    Columns,
    Kernel,
    Term,
    equation,
    kernel,
)
from rig.model.rig import Rig


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        for i in range(x.shape[1]):
            out[TORQUE, i] -= par[i] * x[QD, i]


@dataclass(frozen=True)
class ViscousFriction(Term):
    """Torque Fv_i q_i' against the motion of joint i (Sakai and Maeshima, section II)."""

    name: ClassVar[str] = "viscous_friction"
    kernel: ClassVar[Kernel] = _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return Fv_1 .. Fv_N [N m s/rad]."""
        names = (f"Fv{i}" for i in range(1, len(rig.joints) + 1))
        return tuple(Coefficient(name, rig.unit_of_parameter(name), "mechanical") for name in names)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return q_i' in the rows of joint i."""
        return {
            equation("torque", i): {f"Fv{i + 1}": signals.qd[:, i]} for i in range(signals.joints)
        }


TERMS = (ViscousFriction,)
