"""Flow rows of the paper's model: compressible oil in the chambers, and the valve's orifices."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from analysis.signals.conditioning import Mask, Signals
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
    Array,
    Coefficient,
    Columns,
    Kernel,
    Term,
    U,
    equation,
    kernel,
)
from rig.model.parameters import gain_names, parameter_unit
from rig.model.rig import Rig


@kernel
def _compressibility(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
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
    kernel: ClassVar[Kernel] = _compressibility

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


@kernel
def _orifice(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    p_s, p_t = bench[P_S], bench[P_TANK]
    for i in range(x.shape[1]):
        u, cap, rod = x[U, i], x[P_CAP, i], x[P_ROD, i]
        if u > 0.0:
            out[FLOW_CAP, i] += par[4 * i] * signed_root(p_s - cap) * u
            out[FLOW_ROD, i] -= par[4 * i + 2] * signed_root(rod - p_t) * u
        else:
            out[FLOW_CAP, i] += par[4 * i + 1] * signed_root(cap - p_t) * u
            out[FLOW_ROD, i] -= par[4 * i + 3] * signed_root(p_s - rod) * u


@dataclass(frozen=True)
class Orifice(Term):
    """Turbulent flow through an opening proportional to the spool (docs/method.md).

    cap: C_pp sqrt(p_s - p_cap) u [u>0] + C_pm sqrt(p_cap - p_t) u [u<0];
    rod: - C_mp sqrt(p_rod - p_t) u [u>0] - C_mm sqrt(p_s - p_rod) u [u<0].
    The paper prints the rod's root for u > 0 as zero and divides one rod term by V_cap; here both
    follow from first principles. Outside [p_t, p_s] the root has the drop's sign in simulation, and
    rows are masked.
    """

    name: ClassVar[str] = "orifice"
    kernel: ClassVar[Kernel] = _orifice

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return C_pp C_pm C_mp C_mm of each joint."""
        return _gains(len(rig.joints))

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return sqrt(drop) u of the four metering edges, in the flow rows of their chambers."""
        return edge_columns(signals, root_of_drop)

    def valid(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Mapping[str, Mask]:
        """Return where each chamber's pressure lies in [p_t, p_s]."""
        p_s, p_t = signals.p_s, signals.p_tank
        out: dict[str, Mask] = {}
        for i in signals.excited_joints:
            for kind, pressures in (("flow_cap", signals.p_cap), ("flow_rod", signals.p_rod)):
                p = pressures[:, i]
                out[equation(kind, i)] = (p >= p_t) & (p <= p_s)
        return out


def root_of_drop(drop: Array) -> Array:
    """Return the signed roots [Pa^0.5] of pressure drops (n,) [Pa].

    Not compiled: loading compiled code takes longer than the roots of an identification.
    """
    return np.copysign(np.sqrt(np.abs(drop)), drop)


def edge_columns(signals: Signals, root: Callable[[Array], Array]) -> Columns:
    """Return the columns of the gains of the excited joints: u times `root` of the pressure drops.

    `root` maps the pressure drops of a metering edge (n,) [Pa] to its flow per gain and opening.
    """
    out: Columns = {}
    for i in signals.excited_joints:
        u = signals.u[:, i]
        out |= joint_edge_columns(signals, i, np.maximum(u, 0.0), np.maximum(-u, 0.0), root)
    return out


def joint_edge_columns(
    signals: Signals,
    joint: int,
    positive: Array,
    negative: Array,
    root: Callable[[Array], Array] = root_of_drop,
) -> Columns:
    """Return the columns of a joint's four gains: openings times `root` of the pressure drops.

    `positive` and `negative` (n,) are the openings [V] of the edges that open with a positive and
    with a negative spool.
    """
    pp, pm, mp, mm = gain_names(joint + 1)
    cap, rod, p_s, p_t = (
        signals.p_cap[:, joint], signals.p_rod[:, joint], signals.p_s, signals.p_tank,
    )  # fmt: skip
    return {
        equation("flow_cap", joint): {
            pp: positive * root(p_s - cap), pm: -(negative * root(cap - p_t)),
        },
        equation("flow_rod", joint): {
            mp: -(positive * root(rod - p_t)), mm: negative * root(p_s - rod),
        },
    }  # fmt: skip


@functools.lru_cache
def _gains(joints: int) -> tuple[Coefficient, ...]:
    names = (name for i in range(1, joints + 1) for name in gain_names(i))
    return tuple(Coefficient(name, parameter_unit(name), "fluid") for name in names)


@njit(cache=True)
def signed_root(drop):  # type: ignore[no-untyped-def]
    """Return the signed root [Pa^0.5] of one pressure drop [Pa]."""
    return math.sqrt(drop) if drop >= 0.0 else -math.sqrt(-drop)


TERMS = (Compressibility, Orifice)
