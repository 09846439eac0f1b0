"""Laminar leakage past the piston and out of the chambers.

Flow in proportion to the pressure across a narrow gap (Merritt 1967, chapter 3; Jelali and Kroll
2003): Q = c dp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from analysis.effects.base import Array, Effect, beyond
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    P_CAP,
    P_ROD,
    P_TANK,
    Coefficient,
    Columns,
    Kernel,
    equation,
    kernel,
)
from rig.model.rig import Rig

UNIT = "m^3/(s*Pa)"


@dataclass(frozen=True)
class _Leakage(Effect):
    mechanism: ClassVar[str] = "leakage_curve"
    element: ClassVar[str] = "piston"
    family: ClassVar[str] = "fluid"
    hydraulic: ClassVar[bool] = True
    per_joint: ClassVar[bool] = True
    where: str = "joint 1"

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a leak that pumps, and one of more than half the pump at full pressure."""
        limit = 0.5 * rig.supply.flow / rig.supply.pressure
        name = self.coefficients(rig)[0].parameter
        return beyond(name, values[name], UNIT, limit)


@dataclass(frozen=True)
class InternalLeakage(_Leakage):
    """Q = c (p_cap - p_rod) past the piston, out of the cap side and into the rod side.

    Without it the bulk modulus is biased: 2e-12 m^3/(s Pa) make b of the seed bench 9 to 16 % too
    large.
    """

    name: ClassVar[str] = "internal_leakage"
    least: ClassVar[tuple[float, ...]] = (3e-13,)  # [m^3/(s Pa)]
    variable: ClassVar[str] = "the pressure difference across the piston"
    confounders: ClassVar[tuple[str, ...]] = (
        "external_leakage",
        "underlap_leakage",
        "spool_offset",
        "sensor_offset",
    )
    separated_by: ClassVar[str] = (
        "a load that drives the pressures far apart while the piston rests or creeps"
    )

    @property
    def kernel(self) -> Kernel:
        """The compiled contribution."""
        return _internal

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return c [m^3/(s Pa)]."""
        return (Coefficient(f"c_internal_{self.joint + 1}", UNIT, "fluid"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return -(p_cap - p_rod) for the cap side, the opposite for the rod side."""
        i, name = self.joint, f"c_internal_{self.joint + 1}"
        across = signals.p_cap[:, i] - signals.p_rod[:, i]
        return {equation("flow_cap", i): {name: -across}, equation("flow_rod", i): {name: across}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, c."""
        return np.array([self.joint, values[f"c_internal_{self.joint + 1}"]])

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return p_cap - p_rod [Pa]."""
        across = signals.p_cap[:, self.joint] - signals.p_rod[:, self.joint]
        return {equation(kind, self.joint): across for kind in ("flow_cap", "flow_rod")}


@dataclass(frozen=True)
class ExternalLeakage(_Leakage):
    """Q = c (p - p_tank) out of one chamber, or of both with one c where `where` names none."""

    name: ClassVar[str] = "external_leakage"
    element: ClassVar[str] = "chamber"
    least: ClassVar[tuple[float, ...]] = (3e-13,)  # [m^3/(s Pa)]
    variable: ClassVar[str] = "the chamber's pressure"
    confounders: ClassVar[tuple[str, ...]] = (
        "internal_leakage",
        "underlap_leakage",
        "sensor_offset",
    )
    separated_by: ClassVar[str] = (
        "slow motion at two levels of chamber pressure: rod-side rows show which leak it is"
    )

    @property
    def kernel(self) -> Kernel:
        """The compiled contribution."""
        return _external

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each hydraulic joint, then each of its chambers."""
        return tuple(
            f"{joint}{side}" for joint in super().all_places(rig) for side in ("", " cap", " rod")
        )

    @property
    def _chambers(self) -> tuple[str, ...]:
        return (self.side,) if self.side else ("cap", "rod")

    @property
    def _parameter(self) -> str:
        return f"c_external_{self.joint + 1}" + (f"_{self.side}" if self.side else "")

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return c [m^3/(s Pa)]."""
        return (Coefficient(self._parameter, UNIT, "fluid"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return -(p - p_tank) for each leaking chamber."""
        pressures = {"cap": signals.p_cap, "rod": signals.p_rod}
        return {
            equation(f"flow_{side}", self.joint): {
                self._parameter: signals.p_tank - pressures[side][:, self.joint]
            }
            for side in self._chambers
        }

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, c of the cap side, c of the rod side."""
        c = values[self._parameter]
        return np.array([self.joint, *(c * (side in self._chambers) for side in ("cap", "rod"))])

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return each leaking chamber's pressure [Pa]."""
        pressures = {"cap": signals.p_cap, "rod": signals.p_rod}
        return {
            equation(f"flow_{side}", self.joint): pressures[side][:, self.joint]
            for side in self._chambers
        }


@kernel
def _internal(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        flow = par[1] * (x[P_CAP, i] - x[P_ROD, i])
        out[FLOW_CAP, i] -= flow
        out[FLOW_ROD, i] += flow


@kernel
def _external(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        out[FLOW_CAP, i] -= par[1] * (x[P_CAP, i] - bench[P_TANK])
        out[FLOW_ROD, i] -= par[2] * (x[P_ROD, i] - bench[P_TANK])


TERMS = (InternalLeakage, ExternalLeakage)
