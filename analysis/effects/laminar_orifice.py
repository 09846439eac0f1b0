"""Laminar flow through the metering edges at small pressure drops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from analysis.effects.base import Array, Effect, Shape
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
    equation,
    kernel,
)
from analysis.terms.hydraulics import Orifice, edge_columns, root_of_drop, signed_root
from rig.model.rig import Rig

TRANSITION: Final = "dp_laminar"
SHARPNESS: Final = "sharpness"
SUM: Final = 1.0  # sharpness of a shape that states none: laminar and turbulent drop add


@kernel
def _laminar(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    p_s, p_t, t, n = bench[P_S], bench[P_TANK], par[0], par[1]
    for i in range(x.shape[1]):
        u, cap, rod = x[U, i], x[P_CAP, i], x[P_ROD, i]
        if u > 0.0:
            out[FLOW_CAP, i] += par[2 + 4 * i] * root_change(p_s - cap, t, n) * u
            out[FLOW_ROD, i] -= par[4 + 4 * i] * root_change(rod - p_t, t, n) * u
        else:
            out[FLOW_CAP, i] += par[3 + 4 * i] * root_change(cap - p_t, t, n) * u
            out[FLOW_ROD, i] -= par[5 + 4 * i] * root_change(p_s - rod, t, n) * u


@dataclass(frozen=True)
class LaminarOrifice(Effect):
    """Edges that are laminar at small drops: dp^n = (Q / C u)^2n + (dp_t^(1/2) Q / C u)^n.

    The drops of turbulent and of laminar flow add for n = 1 (Merritt 1967, chapter 3), and the
    larger one alone counts for a large n, the form's sharpness. Far above dp_t the flow is the
    orifice's C u dp^(1/2), far below C u dp / dp_t^(1/2). The columns are the difference from those
    of the orifices, under the same gains; without it the gains are estimated too small.
    """

    name = "laminar_orifice"
    family = "valve"
    mechanism = "metering_curve"
    element = "valve"
    hydraulic = True
    adds_to_gains = True
    alters = ("fluid",)
    smallest_shape = (0.1e6,)  # [Pa]
    variable = "the pressure drop across the metering edges"
    quantity = "pressure"
    confounders = ("tank_pressure", "supply_sag", "sensor_offset")
    separated_by = "loads that leave a small drop across each edge in turn, at several openings"
    shape_stems = (TRANSITION, SHARPNESS)
    kernel = _laminar

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the gains of all joints, which `orifice` owns."""
        return Orifice().coefficients(rig)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the drop of the transition [Pa], and the sharpness."""
        p = rig.supply.pressure
        return (
            Shape(TRANSITION, "Pa", 0.0, 0.5 * p, (0.01 * p, 0.05 * p), 0.0),
            Shape(SHARPNESS, "", 0.7, 6.0, (2.0,), saturates=True, detail=True),
        )

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the opening times the change of the roots, under the orifices' gains."""
        transition, sharpness = self.full_shape(rig, shape)

        def change(drop: Array) -> Array:
            share = share_of_root(np.maximum(np.abs(drop), 1.0), transition, sharpness or SUM)
            return np.asarray(root_of_drop(drop) * (share - 1.0))

        return edge_columns(signals, change)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return dp_t, n, then the gains of each joint."""
        transition, sharpness = self.full_shape(rig, shape)
        gains = (values[c.parameter] for c in self.coefficients(rig))
        return np.array([transition, sharpness or SUM, *gains])

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the drop across the edge that is open [Pa]."""
        out: dict[str, Array] = {}
        p_s, p_t = signals.p_s, signals.p_tank
        for i in signals.excited_joints:
            positive, cap, rod = signals.u[:, i] > 0.0, signals.p_cap[:, i], signals.p_rod[:, i]
            out[equation("flow_cap", i)] = np.where(positive, p_s - cap, cap - p_t)
            out[equation("flow_rod", i)] = np.where(positive, rod - p_t, p_s - rod)
        return out


@njit(cache=True, error_model="numpy")
def share_of_root(size, transition, sharpness):  # type: ignore[no-untyped-def]
    """Return the share of dp^(1/2) that passes at drops of `size` [Pa], n = `sharpness`."""
    laminar = (transition / size) ** (0.5 * sharpness)
    return (2.0 / (laminar + (laminar * laminar + 4.0) ** 0.5)) ** (1.0 / sharpness)


@njit(cache=True, error_model="numpy")
def root_change(drop, transition, sharpness):  # type: ignore[no-untyped-def]
    """Return the change of the signed root [Pa^0.5] of one drop [Pa] by laminar flow."""
    return signed_root(drop) * (share_of_root(max(abs(drop), 1.0), transition, sharpness) - 1.0)


TERMS = (LaminarOrifice,)
