"""Gravity of a planar chain of N links in a vertical plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    THETA,
    TORQUE,
    Array,
    Coefficient,
    Columns,
    Kernel,
    Term,
    equation,
    kernel,
)
from analysis.terms.sine_cosine import sine_cosine
from rig.model.rig import Rig


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    carried = 0.0
    for i in range(x.shape[1] - 1, -1, -1):
        carried += par[i] * sine_cosine(x[THETA, i])[0]
        out[TORQUE, i] -= carried


@dataclass(frozen=True)
class Gravity(Term):
    """V = - sum_k W_k g cos(theta_k): joint i carries sum_{k>=i} W_k g sin(theta_k)."""

    name: ClassVar[str] = "gravity"
    kernel: ClassVar[Kernel] = _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_1 .. W_N [kg m]."""
        names = (f"W{i}" for i in range(1, len(rig.joints) + 1))
        return tuple(Coefficient(name, rig.unit_of_parameter(name), "mechanical") for name in names)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return g sin(theta_k) in the rows of joints 1 .. k."""
        pull = rig.gravity * np.sin(signals.theta)
        return {
            equation("torque", i): {f"W{k + 1}": pull[:, k] for k in range(i, signals.joints)}
            for i in range(signals.joints)
        }

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return W_k g [N m]."""
        return np.array([rig.gravity * values[c.parameter] for c in self.coefficients(rig)])


TERMS = (Gravity,)
