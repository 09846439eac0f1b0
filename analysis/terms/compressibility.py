"""Compressibility of the oil, one bulk modulus for the whole bench."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    V_CAP,
    V_ROD,
    Coefficient,
    Columns,
    Kernel,
    Term,
    equation,
    kernel,
)
from rig.model.parameters import parameter_unit
from rig.model.rig import Rig


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        for i in range(x.shape[1]):
            out[COMP_CAP, i] += par[0] * x[V_CAP, i]
            out[COMP_ROD, i] += par[0] * x[V_ROD, i]


@dataclass(frozen=True)
class Compressibility(Term):
    """- (1/b) V dp/dt in the flow rows of each chamber, linear in 1/b.

    Source: Sakai and Maeshima, section II.
    """

    name: ClassVar[str] = "compressibility"
    kernel: ClassVar[Kernel] = _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return b [Pa], the rows' coefficient being 1/b."""
        return (Coefficient("b", parameter_unit("b"), "fluid", reciprocal=True),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return - V dp/dt of each chamber, V being that of the moving piston."""
        out: Columns = {}
        for i in signals.excited_joints:
            out[equation("flow_cap", i)] = {"b": -signals.V_cap[:, i] * signals.pd_cap[:, i]}
            out[equation("flow_rod", i)] = {"b": -signals.V_rod[:, i] * signals.pd_rod[:, i]}
        return out


TERMS = (Compressibility,)
