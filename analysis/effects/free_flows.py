"""Flows as free curves: metering edges over the spool, compressibility of the oil.

Named effects are special cases of these curves.
"""

from __future__ import annotations

import math
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
    packed,
    shown,
    spline,
)
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    V_CAP,
    V_ROD,
    Coefficient,
    Columns,
    U,
    equation,
    kernel,
)
from analysis.terms.hydraulics import joint_edge_columns, signed_root
from rig.model.parameters import gain_names
from rig.model.rig import Rig
from rig.model.units import plain

OPENINGS: Final = 8  # knots of |u|, the first at the null; f is zero at it and at the last
PACKED: Final = 3 * OPENINGS  # length of an edge's curve as `packed`
# Quantiles of |u| for the knots: overlaps of a few per cent of the stroke lie near the first.
TRAVEL: Final = (0.0, 0.04, 0.09, 0.16, 0.27, 0.45, 0.75, LAST)
SOFTENS: Final = 0.2  # of the compressibility's range: a rise with pressure within uncertainty
PRESSURES: Final = 4  # knots of the oil's pressure; f is zero at the last
BACKWARDS: Final = 0.05  # of an edge's largest flow: a reverse flow within its uncertainty
EDGES: Final = ("pp", "pm", "mp", "mm")


@kernel
def _edges(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    i = int(par[0])
    u, cap, rod = x[U, i], x[P_CAP, i], x[P_ROD, i]
    if u > 0.0:
        out[FLOW_CAP, i] += curve_at(u, par, 1, OPENINGS) * signed_root(bench[P_S] - cap)
        out[FLOW_ROD, i] -= curve_at(u, par, 1 + 2 * PACKED, OPENINGS) * signed_root(
            rod - bench[P_TANK]
        )
    elif u < 0.0:
        out[FLOW_CAP, i] -= curve_at(-u, par, 1 + PACKED, OPENINGS) * signed_root(
            cap - bench[P_TANK]
        )
        out[FLOW_ROD, i] += curve_at(-u, par, 1 + 3 * PACKED, OPENINGS) * signed_root(
            bench[P_S] - rod
        )


@dataclass(frozen=True)
class MeteringCurve(Effect):
    """Each edge passes (C |u| + f(|u|)) sqrt(dp): an edge's form over the spool, f a curve.

    f is zero at the null and at the largest opening of the records, where C is the whole edge.
    """

    name = "metering_curve"
    family = "valve"
    mechanism = "metering_curve"
    element = "valve"
    free = True
    by_data = True
    hydraulic = True
    variable = "the spool"
    quantity = "spool"
    confounders = ("leakage_curve", "supply_sag", "tank_pressure")
    separated_by = "the same opening at several pressures across the edge"
    kernel = _edges
    where: str = "joint 1"

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots."""
        return tuple(f"opening_{self.joint + 1}_knot_{k}" for k in range(1, OPENINGS + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the knots [V]."""
        stroke = rig.joints[self.joint].valve.spool_stroke
        return knot_shapes(self.shape_names(), "V", 0.0, stroke)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots at quantiles of the spool's travel."""
        travel = evidence.of_joint(self.joint, lambda x: np.abs(x.u[:, self.joint]))
        return knot_points(travel, TRAVEL, low=0.0)

    def _names(self, edge: str) -> tuple[str, ...]:
        return tuple(f"C_{edge}_{self.joint + 1}_at_{k}" for k in range(2, OPENINGS))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the values of f at the inner knots, edge by edge [m^3/(s Pa^0.5)]."""
        names = (name for edge in EDGES for name in self._names(edge))
        return tuple(Coefficient(name, "m^3/(s*Pa^0.5)", "fluid") for name in names)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the curve's basis times the root of the pressure drop of the open edge."""
        u, edges = signals.u[:, self.joint], gain_names(self.joint + 1)
        basis = spline(self.shape_of(rig, shape), np.abs(u))[:, 1:-1]
        names = {gain: self._names(edge) for gain, edge in zip(edges, EDGES, strict=True)}
        rows = joint_edge_columns(
            signals, self.joint, np.where(u > 0.0, 1.0, 0.0), np.where(u < 0.0, 1.0, 0.0)
        )
        return {
            e: {
                name: column
                for gain, root in row.items()
                for name, column in zip(names[gain], (root[:, None] * basis).T, strict=True)
            }
            for e, row in rows.items()
        }

    def _values(self, values: Mapping[str, float], edge: str) -> Array:
        return np.array([0.0, *(values[name] for name in self._names(edge)), 0.0])

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, then the curve of each edge."""
        knots = self.shape_of(rig, shape)
        curves = [packed(knots, self._values(values, edge)) for edge in EDGES]
        return np.concatenate(([self.joint], *curves))

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return flow into each chamber over root of pressure drop, over the spool."""
        at = shown(shape)
        x = np.concatenate((-at[::-1], at))
        basis = spline(shape, np.abs(x))[:, 1:-1]
        pp, pm, mp, mm = gain_names(self.joint + 1)
        unit = "m^3/(s*Pa^0.5)"
        out = []
        for label, positive, negative, gains, sign in (
            ("cap edges over the spool", "pp", "pm", (pp, pm), 1.0),
            ("rod edges over the spool", "mp", "mm", (mp, mm), -1.0),
        ):
            weights = {gains[0]: sign * np.maximum(x, 0.0), gains[1]: sign * np.minimum(x, 0.0)}
            weights |= zip(self._names(positive), (sign * (x > 0.0) * basis.T), strict=True)
            weights |= zip(self._names(negative), (-sign * (x < 0.0) * basis.T), strict=True)
            out.append(Branch(label, x, weights, "V", unit))
        return tuple(out)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject an edge that passes oil backwards or closes as the spool opens it."""
        knots = self.shape_of(rig, shape)
        at = shown(knots)
        for edge, gain in zip(EDGES, gain_names(self.joint + 1), strict=True):
            curve = spline(knots, at) @ self._values(values, edge)
            whole = curve + values.get(gain, 0.0) * at
            lowest = -BACKWARDS * float(np.max(np.abs(whole)))
            if np.min(whole) < lowest or np.min(whole - np.maximum.accumulate(whole)) < lowest:
                return f"edge {gain} would close as the spool opens it, or pass oil backwards"
        return ""

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State at which opening the gains hold."""
        gains, largest = gain_names(self.joint + 1), self.shape_of(rig, shape)[-1]
        return (
            f"{', '.join(gains)} are each edge's flow over the spool at the largest opening of "
            f"these records, {plain(largest, 3)} V; at smaller ones the curve says how it differs"
        )


@kernel
def _softness(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        for i in range(x.shape[1]):
            out[COMP_CAP, i] += x[V_CAP, i] * curve_at(x[P_CAP, i], par, 0, 4)
            out[COMP_ROD, i] += x[V_ROD, i] * curve_at(x[P_ROD, i], par, 0, 4)


@dataclass(frozen=True)
class BulkModulusCurve(Effect):
    """1/b_eff = 1/b + f(p): the oil's compressibility over its pressure, f a curve.

    f is zero at the highest pressure of the records, where b is the whole modulus.
    """

    name = "bulk_modulus_curve"
    family = "fluid"
    mechanism = "bulk_modulus_curve"
    element = "chamber"
    free = True
    by_data = True
    hydraulic = True
    variable = "the pressure rate, by the pressure"
    quantity = "pressure"
    confounders = ("dead_volume", "spool_lag")
    separated_by = "fast pressure changes at low and at high chamber pressure"
    kernel = _softness

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots."""
        return tuple(f"bulk_knot_{k}" for k in range(1, PRESSURES + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the knots [Pa]."""
        return knot_shapes(self.shape_names(), "Pa", 0.0, rig.supply.pressure)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots at quantiles of the moving joints' chamber pressures."""
        joints = range(len(rig.joints))
        parts = [evidence.of_joint(i, lambda x, i=i: x.p_cap[:, i]) for i in joints]  # type: ignore[misc]
        parts += [evidence.of_joint(i, lambda x, i=i: x.p_rod[:, i]) for i in joints]  # type: ignore[misc]
        return knot_points(np.concatenate(parts), (1.0 - LAST, 0.25, 0.65, LAST))

    def _names(self) -> tuple[str, ...]:
        return tuple(f"softness_{k}" for k in range(1, PRESSURES))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the additional compressibility at the knots [1/Pa]."""
        return tuple(Coefficient(name, "Pa^-1", "fluid") for name in self._names())

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return - V dp/dt times the curve's basis of each chamber."""
        knots, out = self.shape_of(rig, shape), {}
        for i in signals.excited_joints:
            for side, V, p, rate in (
                ("flow_cap", signals.V_cap, signals.p_cap, signals.pd_cap),
                ("flow_rod", signals.V_rod, signals.p_rod, signals.pd_rod),
            ):
                basis = spline(knots, p[:, i])[:, :-1]
                columns = (-(V[:, i] * rate[:, i])[:, None] * basis).T
                out[equation(side, i)] = dict(zip(self._names(), columns, strict=True))
        return out

    def _values(self, values: Mapping[str, float]) -> Array:
        return np.array([*(values[name] for name in self._names()), 0.0])

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the curve."""
        return packed(self.shape_of(rig, shape), self._values(values))

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the bulk modulus [Pa] over pressure [Pa]."""
        at = shown(shape)
        weights = dict(zip(self._names(), spline(shape, at)[:, :-1].T, strict=True))
        weights["b"] = np.ones_like(at)
        return (Branch("bulk modulus over pressure", at, weights, "Pa", "Pa", reciprocal=True),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject oil that is not compressible, or softer at higher pressure."""
        knots = self.shape_of(rig, shape)
        b = values.get("b", rig.nominal.get("b", math.nan))
        soft = spline(knots, shown(knots)) @ self._values(values) + 1.0 / b
        if np.min(soft) <= 0.0:
            return "the oil would not be compressible"
        # Air and hoses are softest at low pressure, and oil stiffens with pressure.
        rise = float(np.max(soft - np.minimum.accumulate(soft)))
        stiffens = rise <= SOFTENS * float(np.ptp(soft))
        return "" if stiffens else "the oil would be softer at higher pressure"


TERMS = (MeteringCurve, BulkModulusCurve)
