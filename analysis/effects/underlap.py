"""Underlapped metering edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Shape
from analysis.effects.edges import corner, edge, opened, rounding
from analysis.effects.valve import ValveEffect
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    Coefficient,
    Columns,
    U,
    kernel,
)
from analysis.terms.hydraulics import joint_edge_columns, signed_root
from rig.model.parameters import gain_names, parameter_unit
from rig.model.rig import Rig

MOST_OVERLAP: Final = 0.07  # of the stroke: a third of the largest rounding, which keeps it open
OVERLAPS: Final = 0.02  # of the rounding: with less the edges meet at the null
CLOSED: Final = 0.25  # of an overlap: less is open at the null where clearance alone rounds edges


@kernel
def _underlap(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    i = int(par[0])
    u, w = x[U, i], par[5]
    positive = edge(u + w, par[6], par[7]) - max(u, 0.0)
    negative = edge(w - u, par[6], par[7]) - max(-u, 0.0)
    cap, rod, p_s, p_t = x[P_CAP, i], x[P_ROD, i], bench[P_S], bench[P_TANK]
    into_cap = par[1] * positive * signed_root(p_s - cap)
    into_rod = par[4] * negative * signed_root(p_s - rod)
    out[FLOW_CAP, i] += into_cap - par[2] * negative * signed_root(cap - p_t)
    out[FLOW_ROD, i] += into_rod - par[3] * positive * signed_root(rod - p_t)


@dataclass(frozen=True)
class UnderlapLeakage(ValveEffect):
    """Edges open by w at the null: openings max(w + u, 0) and max(w - u, 0).

    Openings added to the zero-lap orifice: d+ = max(u + w, 0) - max(u, 0) of the edges that open
    with a positive u, d- = max(w - u, 0) - max(-u, 0) of the others, rounded as those of
    `valve_deadband`, each times its own gain and root (Merritt 1967, chapter 5, open-centre valve).
    The gains are those of the orifices, whose columns they add to. A negative w is an overlap that
    is less than what the rounding leaves open at the null.
    """

    name = "underlap_leakage"
    smallest_shape = (4e-3,)  # [V]
    prepares = False
    adds_to_gains = True
    variable = "the spool near its null and the chamber pressures"
    confounders = ("valve_deadband", "internal_leakage", "external_leakage")
    separated_by = (
        "small spool amplitudes about the null beside large ones: leakage of seals does not depend "
        "on the spool"
    )
    shape_stems = ("w_underlap", "rounding", "corner")
    kernel = _underlap

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the joint's four gains, which `orifice` owns."""
        names = gain_names(self.joint + 1)
        return tuple(Coefficient(name, parameter_unit(name), "fluid") for name in names)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the underlap [V], up to half of the stroke, and the edges' form."""
        stroke = rig.joints[self.joint].valve.spool_stroke
        grid = (0.002 * stroke, 0.006 * stroke, 0.02 * stroke, 0.1 * stroke)
        lap, r, c = self.shape_names()
        low, high = -MOST_OVERLAP * stroke, 0.5 * stroke
        return Shape(lap, "V", low, high, grid, 0.0), rounding(r, stroke), corner(c)

    def inseparable(self, shape: Sequence[float] = ()) -> tuple[tuple[str, str], ...]:
        """Return the dead band of edges that overlap by over `OVERLAPS` of their rounding."""
        worn = len(shape) > 1 and shape[0] < -OVERLAPS * shape[1]
        return (("valve_deadband", self.place),) if worn else ()

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject an overlap that leaves less than `CLOSED` of itself open at the null."""
        w, r, c = self.full_shape(rig, shape)
        if w < 0.0 and edge(w, r, c) < CLOSED * -w:
            return f"an overlap of {-w:.3g} V closes the edges at the null: that is a dead band"
        return super().problem(rig, values, shape)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the additional openings times the roots, under the orifices' own names."""
        u, (w, r, c) = signals.u[:, self.joint], self.full_shape(rig, shape)
        positive = opened(u + w, r, c) - np.maximum(u, 0.0)
        negative = opened(w - u, r, c) - np.maximum(-u, 0.0)
        return joint_edge_columns(signals, self.joint, positive, negative)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, gains, underlap, rounding, corner."""
        gains = [values[name] for name in gain_names(self.joint + 1)]
        return np.array([self.joint, *gains, *self.full_shape(rig, shape)])


TERMS = (UnderlapLeakage,)
