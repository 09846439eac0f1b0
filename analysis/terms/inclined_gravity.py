"""Gravity of a planar chain on a base of unknown inclination, common to all joints."""

from __future__ import annotations

import math
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
    ParameterReduction,
    Term,
    equation,
    kernel,
)
from analysis.terms.sine_cosine import sine_cosine
from rig.model.rig import Rig

PARAMETER = "base_inclination"


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    N = x.shape[1]
    carried = 0.0
    for i in range(N - 1, -1, -1):
        carried += par[i] * sine_cosine(x[THETA, i] + par[N])[0]
        out[TORQUE, i] -= carried


@dataclass(frozen=True)
class InclinedGravity(Term):
    """V = - sum_k W_k g cos(theta_k + alpha), in place of `gravity`.

    Link k pulls W_k g sin(theta_k + alpha) = g [W_k cos(alpha) sin(theta_k) + W_k sin(alpha)
    cos(theta_k)]: linear in 2 N unknowns that share alpha. `reduction` maps them to the N + 1
    parameters (docs/n-joints.md; the common parameter of Sakai and Maeshima's last claim).
    """

    name: ClassVar[str] = "inclined_gravity"
    kernel: ClassVar[Kernel] = _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_k cos(alpha), then W_k sin(alpha) [kg m]."""
        names = _linear(len(rig.joints))
        return tuple(Coefficient(name, "kg*m", "mechanical") for name in names)

    def parameters(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_1 .. W_N [kg m] and alpha [rad]."""
        weights = (f"W{i}" for i in range(1, len(rig.joints) + 1))
        named = tuple(Coefficient(name, "kg*m", "mechanical") for name in weights)
        return (*named, Coefficient(PARAMETER, "rad", "mechanical"))

    def reduction(self, rig: Rig) -> ParameterReduction:
        """Return x = (W cos(alpha), W sin(alpha)) of p = (W, alpha), W positive in sum."""
        N = len(rig.joints)

        def start(x: Array) -> Array:
            # (W, alpha) and (-W, alpha + pi) pull alike; links hang down by their own weight.
            alpha = math.atan2(float(x[N:].sum()), float(x[:N].sum()))
            return np.append(x[:N] * math.cos(alpha) + x[N:] * math.sin(alpha), alpha)

        def value(p: Array) -> Array:
            return np.concatenate((p[:N] * math.cos(p[N]), p[:N] * math.sin(p[N])))

        def slope(p: Array) -> Array:
            c, s, eye = math.cos(p[N]), math.sin(p[N]), np.eye(N)
            by_angle = np.concatenate((-p[:N] * s, p[:N] * c))
            return np.column_stack((np.vstack((c * eye, s * eye)), by_angle))

        names = tuple(c.parameter for c in self.parameters(rig))
        return ParameterReduction(_linear(N), names, start, value, slope)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return g sin(theta_k) and g cos(theta_k) in the rows of joints 1 .. k."""
        N = signals.joints
        names = _linear(N)
        sine, cosine = (rig.gravity * f(signals.theta) for f in (np.sin, np.cos))
        return {
            equation("torque", i): {
                **{names[k]: sine[:, k] for k in range(i, N)},
                **{names[N + k]: cosine[:, k] for k in range(i, N)},
            }
            for i in range(N)
        }

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return W_k g [N m], then alpha [rad]."""
        weights = [rig.gravity * values[f"W{i}"] for i in range(1, len(rig.joints) + 1)]
        return np.array([*weights, values[PARAMETER]])


def _linear(joints: int) -> tuple[str, ...]:
    each = range(1, joints + 1)
    return (*(f"W{i} cos" for i in each), *(f"W{i} sin" for i in each))


TERMS = (InclinedGravity,)
