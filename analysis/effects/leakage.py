"""Leakage past the piston and out of the chambers, over the pressure difference dp across it.

Through a narrow gap the flow is in proportion to dp, through an opening with sharp edges to its
root (Merritt 1967, chapter 3; Jelali and Kroll 2003). With an exponent n between the two

    Q = c dp (|dp| / p_r)^(n - 1),  p_r = 1 MPa,

so that c is the flow over dp at 1 MPa. n is a detail of the form: without it the leak is laminar,
Q = c dp. Below 1 kPa the slope of an exponent is kept finite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from analysis.effects.base import Array, Effect, Shape, exponent, out_of_range
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
    equation,
    kernel,
)
from rig.model.rig import Rig

UNIT: Final = "m^3/(s*Pa)"
EXPONENT_BOUNDS: Final = (0.4, 1.0)  # 0.5 of a sharp edge, 1 of a narrow gap
EXPONENT_START: Final = 0.7  # where a search begins
REFERENCE: Final = 1e6  # [Pa] where c is the flow over dp whatever the exponent
LINEAR_BELOW: Final = 1e3  # [Pa] below it the flow is in proportion to dp


@dataclass(frozen=True)
class _Leakage(Effect):
    mechanism = "leakage_curve"
    element = "piston"
    family = "fluid"
    hydraulic = True
    shape_stems = ("exponent",)
    where: str = "joint 1"

    @property
    def _parameter(self) -> str:
        return f"c_{self.suffix}"

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return c [m^3/(s Pa)]."""
        return (Coefficient(self._parameter, UNIT, "fluid"),)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the exponent n [-]."""
        (name,) = self.shape_names()
        return (Shape(name, "", *EXPONENT_BOUNDS, (EXPONENT_START,), detail=True),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative leak, and more than half the pump's flow at supply pressure."""
        name, flow_per_c = self._parameter, float(flow_form(rig.supply.pressure, exponent(shape)))
        return out_of_range(name, values[name], UNIT, 0.5 * rig.supply.flow / flow_per_c)

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the exponent and where c holds, of a leak that is not laminar."""
        n = exponent(shape)
        if n == 1.0:
            return ""
        return (
            f"the flow goes with the pressure difference to the power of {n:.2g}; "
            f"{self._parameter} is the flow over the pressure difference at 1 MPa"
        )


def with_chambers(joints: Sequence[str]) -> tuple[str, ...]:
    """Return each of the places `joint I`, then each of its chambers."""
    return tuple(f"{joint}{side}" for joint in joints for side in ("", " cap", " rod"))


@njit(cache=True)
def flow_form(drop, n):  # type: ignore[no-untyped-def]
    """Return dp (|dp| / p_r)^(n - 1) [Pa] of pressure differences dp [Pa] (see the module)."""
    if n == 1.0:
        return drop
    return drop * ((drop * drop + LINEAR_BELOW**2) / REFERENCE**2) ** (0.5 * (n - 1.0))


@kernel
def _internal(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        flow = par[1] * flow_form(x[P_CAP, i] - x[P_ROD, i], par[2])
        out[FLOW_CAP, i] -= flow
        out[FLOW_ROD, i] += flow


@dataclass(frozen=True)
class InternalLeakage(_Leakage):
    """Leak over dp = p_cap - p_rod past the piston, out of the cap side and into the rod side.

    Without it the bulk modulus is biased: 2e-12 m^3/(s Pa) make b of the seed bench 9 to 16 % too
    large.
    """

    name = "internal_leakage"
    smallest_coefficients = (3e-13,)  # [m^3/(s Pa)]
    variable = "the pressure difference across the piston"
    quantity = "pressure difference"
    confounders = ("external_leakage", "underlap_leakage", "spool_offset", "sensor_offset")
    separated_by = "a load that drives the pressures far apart while the piston rests or creeps"
    kernel = _internal

    @property
    def suffix(self) -> str:
        """How its parameters' names end: `internal_1`."""
        return f"internal_{super().suffix}"

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the flow per unit c, out of the cap side and into the rod side."""
        i, name = self.joint, self._parameter
        flow = flow_form(signals.p_cap[:, i] - signals.p_rod[:, i], exponent(shape))
        return {equation("flow_cap", i): {name: -flow}, equation("flow_rod", i): {name: flow}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, c, n."""
        return np.array([self.joint, values[self._parameter], exponent(shape)])

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return p_cap - p_rod [Pa]."""
        across = signals.p_cap[:, self.joint] - signals.p_rod[:, self.joint]
        return {equation(kind, self.joint): across for kind in ("flow_cap", "flow_rod")}


@kernel
def _external(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        out[FLOW_CAP, i] -= par[1] * flow_form(x[P_CAP, i] - bench[P_TANK], par[3])
        out[FLOW_ROD, i] -= par[2] * flow_form(x[P_ROD, i] - bench[P_TANK], par[3])


@dataclass(frozen=True)
class ExternalLeakage(_Leakage):
    """Leak over dp = p - p_tank out of one chamber, or of both with one c if `where` names none."""

    name = "external_leakage"
    element = "chamber"
    smallest_coefficients = (3e-13,)  # [m^3/(s Pa)]
    variable = "the chamber's pressure"
    quantity = "pressure"
    confounders = ("internal_leakage", "underlap_leakage", "sensor_offset")
    separated_by = (
        "slow motion at two levels of chamber pressure: rod-side rows show which leak it is"
    )
    kernel = _external

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each hydraulic joint, then each of its chambers."""
        return with_chambers(super().all_places(rig))

    @property
    def _chambers(self) -> tuple[str, ...]:
        return (self.side,) if self.side else ("cap", "rod")

    @property
    def suffix(self) -> str:
        """How its parameters' names end: `external_1`, `external_1_cap`."""
        return f"external_{super().suffix}"

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the flow per unit c out of each leaking chamber."""
        pressures, n = {"cap": signals.p_cap, "rod": signals.p_rod}, exponent(shape)
        return {
            equation(f"flow_{side}", self.joint): {
                self._parameter: flow_form(signals.p_tank - pressures[side][:, self.joint], n)
            }
            for side in self._chambers
        }

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, c of the cap side, c of the rod side, n."""
        c = values[self._parameter]
        leaks = (c * (side in self._chambers) for side in ("cap", "rod"))
        return np.array([self.joint, *leaks, exponent(shape)])


TERMS = (InternalLeakage, ExternalLeakage)
