"""Leakage as free curves: over the pressure across it, over the position of the piston.

Named leaks are special cases of these curves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Branch, Effect, Evidence, Shape
from analysis.effects.curve import (
    LAST,
    curve_at,
    knot_points,
    knot_shapes,
    outer_knots,
    packed,
    refuse_large,
    shown,
    spline,
)
from analysis.effects.leakage import UNIT, with_chambers
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
    S,
    equation,
    kernel,
)
from rig.model.rig import Rig

DROPS: Final = 9  # knots of a leak's pressure, the first at zero: a relief valve opens suddenly
PLACES: Final = 9  # knots of the piston's position: wear is local
BACKWARDS: Final = 0.05  # of a leak's largest flow: a reverse flow within its uncertainty


@dataclass(frozen=True)
class _FreeLeakage(Effect):
    family = "fluid"
    mechanism = "leakage_curve"
    element = "piston"
    free = True
    by_data = True
    hydraulic = True
    where: str = "joint 1"

    def _refused(self, rig: Rig, flow: Array) -> str:
        """Return the message for a flow (m,) [m^3/s] that is reversed or above half the pump's."""
        if np.min(flow) < -BACKWARDS * float(np.max(np.abs(flow))):
            return "the leak would pump"
        return refuse_large(flow, 0.5 * rig.supply.flow, "the leak", "m³/s")


@kernel
def _leak(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    i = int(par[0])
    side = int(par[1])
    cap, rod = x[P_CAP, i], x[P_ROD, i]
    drop = cap - rod if side == 0 else (cap if side == 1 else rod) - bench[P_TANK]
    flow = curve_at(abs(drop), par, 2, DROPS)
    flow = flow if drop > 0.0 else -flow
    if side == 0:
        out[FLOW_CAP, i] -= flow
        out[FLOW_ROD, i] += flow
    elif side == 1:
        out[FLOW_CAP, i] -= flow
    else:
        out[FLOW_ROD, i] -= flow


@dataclass(frozen=True)
class LeakageCurve(_FreeLeakage):
    """Q = f(|dp|) sign(dp): a leak over the pressure across it, f a curve with f(0) = 0.

    Between the chambers, or out of one of them to the tank.
    """

    name = "leakage_curve"
    variable = "the pressure across the leak"
    quantity = "pressure across the leak"
    confounders = ("metering_curve", "underlap_leakage")
    separated_by = "a load that drives the pressures far apart while the piston hardly moves"
    kernel = _leak

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each joint, between its chambers, then each of its chambers."""
        return with_chambers(super().all_places(rig))

    def across(self, signals: Signals) -> Array:
        """Return the pressure across the leak (n,) [Pa]."""
        cap, rod = signals.p_cap[:, self.joint], signals.p_rod[:, self.joint]
        if not self.side:
            return np.asarray(cap - rod)
        return np.asarray((cap if self.side == "cap" else rod) - signals.p_tank)

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots."""
        return tuple(f"leak_{self.suffix}_knot_{k}" for k in range(1, DROPS + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the knots [Pa]."""
        return knot_shapes(self.shape_names(), "Pa", 0.0, rig.supply.pressure)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots at quantiles of the pressure across the leak."""
        drop = evidence.of_joint(self.joint, lambda x: np.abs(self.across(x)))
        return knot_points(drop, np.linspace(0.0, LAST, DROPS).tolist(), low=0.0)

    def _names(self) -> tuple[str, ...]:
        return tuple(f"Q_leak_{self.suffix}_{k}" for k in range(2, DROPS + 1))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the flows at the knots [m^3/s]."""
        return tuple(Coefficient(name, "m^3/s", "fluid") for name in self._names())

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the curve's basis, out of the chamber that leaks and into the other."""
        drop = self.across(signals)
        basis = spline(self.shape_of(rig, shape), np.abs(drop))[:, 1:]
        gained = dict(zip(self._names(), (np.sign(drop) * basis.T), strict=True))
        lost = {name: -column for name, column in gained.items()}
        i = self.joint
        if self.side:
            return {equation(f"flow_{self.side}", i): lost}
        return {equation("flow_cap", i): lost, equation("flow_rod", i): gained}

    def _values(self, values: Mapping[str, float]) -> Array:
        return np.array([0.0, *(values[name] for name in self._names())])

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, side (0 for between the chambers, 1 cap, 2 rod), curve."""
        side = ("", "cap", "rod").index(self.side)
        curve = packed(self.shape_of(rig, shape), self._values(values))
        return np.array([self.joint, side, *curve])

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the flow [m^3/s] over the pressure [Pa]."""
        at = shown(shape)
        weights = dict(zip(self._names(), spline(shape, at)[:, 1:].T, strict=True))
        return (Branch("leakage over pressure", at, weights, "Pa", "m^3/s"),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a reversed leak, and more than half of the pump's flow."""
        knots = self.shape_of(rig, shape)
        return self._refused(rig, spline(knots, shown(knots)) @ self._values(values))

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the pressure across the leak [Pa]."""
        kinds = (f"flow_{self.side}",) if self.side else ("flow_cap", "flow_rod")
        return {equation(kind, self.joint): self.across(signals) for kind in kinds}


@kernel
def _along_stroke(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        place = min(max(x[S, i], par[1]), par[PLACES])
        flow = curve_at(place, par, 1, PLACES) * (x[P_CAP, i] - x[P_ROD, i])
        out[FLOW_CAP, i] -= flow
        out[FLOW_ROD, i] += flow


@dataclass(frozen=True)
class LeakageAlongStroke(_FreeLeakage):
    """Q = f(s) dp: a laminar leak past the piston over its position, f a curve (`curve`).

    A bore that is worn where the piston moves most leaks more there. Beyond the outer knots f keeps
    its value there: a straight line would soon pump.
    """

    name = "leakage_along_stroke"
    variable = "the pressure difference across the piston, by its position"
    quantity = "position"
    confounders = ("leakage_curve", "internal_leakage")
    separated_by = "the same motion about several places of the stroke"
    kernel = _along_stroke

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots."""
        return tuple(f"leak_{self.joint + 1}_place_knot_{k}" for k in range(1, PLACES + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the knots [m]."""
        return knot_shapes(self.shape_names(), "m", *rig.joints[self.joint].position_range)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots evenly over the piston's travel: wear may be where it seldom is."""
        place = evidence.of_joint(self.joint, lambda x: x.s[:, self.joint])
        return knot_points(outer_knots(place), np.linspace(0.0, 1.0, PLACES).tolist())

    def _names(self) -> tuple[str, ...]:
        return tuple(f"c_internal_{self.joint + 1}_at_{k}" for k in range(1, PLACES + 1))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the flow over the pressure difference at the knots [m^3/(s Pa)]."""
        return tuple(Coefficient(name, UNIT, "fluid") for name in self._names())

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the curve's basis times the pressure difference, out of cap and into rod side."""
        i, knots = self.joint, self.shape_of(rig, shape)
        drop = signals.p_cap[:, i] - signals.p_rod[:, i]
        place = np.clip(signals.s[:, i], knots[0], knots[-1])
        flows = (drop[:, None] * spline(knots, place)).T
        into_rod = dict(zip(self._names(), flows, strict=True))
        into_cap = {name: -flow for name, flow in into_rod.items()}
        return {equation("flow_cap", i): into_cap, equation("flow_rod", i): into_rod}

    def _values(self, values: Mapping[str, float]) -> Array:
        return np.array([values[name] for name in self._names()])

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, curve."""
        return np.array([self.joint, *packed(self.shape_of(rig, shape), self._values(values))])

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the flow over the pressure difference [m^3/(s Pa)] over the position [m]."""
        at = shown(shape)
        weights = dict(zip(self._names(), spline(shape, at).T, strict=True))
        return (Branch("leakage over position", at, weights, "m", UNIT),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a reversed leak, and more than half of the pump's flow under load.

        The load is half of the supply's pressure: more across the piston hardly occurs.
        """
        knots = self.shape_of(rig, shape)
        size = spline(knots, shown(knots)) @ self._values(values)
        return self._refused(rig, 0.5 * size * rig.supply.pressure)


TERMS = (LeakageCurve, LeakageAlongStroke)
