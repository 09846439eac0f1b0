"""Drop of the supply pressure over the drawn flow, as a free curve."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from analysis.effects.base import Array, Branch, Evidence, Shape
from analysis.effects.curve import (
    LAST,
    curve_at,
    knot_shapes,
    packed,
    shown,
    spline,
    spread_knots,
)
from analysis.effects.supply import PortEffect, edge_gains, in_every_flow, port_flow
from analysis.signals.conditioning import Signals
from analysis.terms.base import P_CAP, P_ROD, P_S, PREPARE, U, kernel
from rig.model.rig import Rig

FLOWS: Final = 3  # knots of the flow, the first at zero, without a drop
STARTS: Final = (0.05, 0.2)  # starting drops at the pump's flow, of the supply pressure


@kernel
def _line_drop(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # Bisection: the line's flow is what the open edges draw at the pressure after the drop.
    if phase == PREPARE:
        low, high = 0.0, 0.0
        for i in range(x.shape[1]):
            u = x[U, i]
            p = x[P_CAP, i] if u > 0.0 else x[P_ROD, i]
            gain = par[9 + 2 * i] if u > 0.0 else par[10 + 2 * i]
            high += gain * abs(u) * math.sqrt(max(bench[P_S] - p, 0.0))
        for _ in range(48):
            flow = 0.5 * (low + high)
            port, drawn = bench[P_S] - curve_at(flow, par, 0, 3), 0.0
            for i in range(x.shape[1]):
                u = x[U, i]
                p = x[P_CAP, i] if u > 0.0 else x[P_ROD, i]
                gain = par[9 + 2 * i] if u > 0.0 else par[10 + 2 * i]
                drawn += gain * abs(u) * math.sqrt(max(port - p, 0.0))
            if drawn > flow:
                low = flow
            else:
                high = flow
        bench[P_S] -= curve_at(low, par, 0, 3)


@dataclass(frozen=True)
class SupplyCurve(PortEffect):
    """The valves see p_s - f(Q): the supply's drop over the flow drawn, f a curve with f(0) = 0.

    Its values at the knots are inside the orifices' roots, so that they are shapes.
    """

    name = "supply_curve"
    mechanism = "supply_curve"
    element = "supply"
    free = True
    by_data = True
    variable = "the flow drawn from the supply"
    quantity = "flow drawn"
    confounders = ("metering_curve", "tank_pressure")
    separated_by = "two amplitudes, one and both joints at once"
    kernel = _line_drop

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots, then the drops at those above zero."""
        knots = tuple(f"supply_knot_{k}" for k in range(1, FLOWS + 1))
        return (*knots, *(f"supply_drop_{k}" for k in range(2, FLOWS + 1)))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the knots [m^3/s] and the drops [Pa]."""
        names, p = self.shape_names(), rig.supply.pressure
        drops = (
            Shape(name, "Pa", 0.0, 0.9 * p, tuple(share * p for share in STARTS), 0.0)
            for name in names[FLOWS:]
        )
        return (*knot_shapes(names[:FLOWS], "m^3/s", 0.0, rig.supply.flow), *drops)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots at quantiles of the drawn flow, with drops in proportion to it."""
        flow = evidence.of_bench(lambda x: port_flow(rig, x, drawn=True))
        knots = spread_knots(flow, (0.0, 0.6, LAST), low=0.0)
        if not len(knots):
            return ()
        p, share = rig.supply.pressure, knots[1:] / rig.supply.flow
        return tuple((*map(float, knots), *map(float, start * p * share)) for start in STARTS)

    def _drops(self, shape: Sequence[float]) -> Array:
        return np.array([0.0, *shape[FLOWS:]])

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Subtract the drop from the supply pressure."""
        shape = self.shape_of(rig, shape)
        flow = port_flow(rig, signals, drawn=True)
        return replace(signals, p_s=signals.p_s - spline(shape[:FLOWS], flow) @ self._drops(shape))

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the curve, then C_pp and C_mm of each joint."""
        shape = self.shape_of(rig, shape)
        curve = packed(shape[:FLOWS], self._drops(shape))
        return np.concatenate((curve, edge_gains(rig, values, (0, 3))))

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the drop [Pa] over the flow [m^3/s]."""
        at = shown(shape[:FLOWS])
        basis = spline(shape[:FLOWS], at)[:, 1:]
        weights = dict(zip(self.shape_names()[FLOWS:], basis.T, strict=True))
        return (Branch("supply's drop over flow", at, weights, "m^3/s", "Pa"),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject drops at their bounds, and one that falls as the flow rises."""
        shape = self.shape_of(rig, shape)
        drop = spline(shape[:FLOWS], shown(shape[:FLOWS])) @ self._drops(shape)
        if np.min(np.diff(drop)) < -1e-3 * float(np.max(np.abs(drop))):
            return "the supply would lose less at more flow"
        return self.outside(rig, shape)

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the flow drawn [m^3/s]."""
        return in_every_flow(signals, port_flow(rig, signals, drawn=True))


TERMS = (SupplyCurve,)
