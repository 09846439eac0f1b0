"""Torque rows of the paper's model: inertia, viscous friction and gravity of a planar chain.

`inclined_gravity` replaces `gravity` on a base of unknown inclination.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    QD,
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
from rig.model.parameters import inertia_names
from rig.model.rig import Rig

INCLINATION: Final = "base_inclination"


@kernel
def _inertia(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    N = x.shape[1]
    for k in range(N):
        rate_k = 0.0
        for m in range(k + 1):
            rate_k += x[QD, m]
        for j in range(k, N):
            R = par[k * N + j]
            if R == 0.0:
                continue
            if j == k:
                for a in range(k + 1):
                    for b in range(k + 1):
                        M[a, b] += R
                continue
            rate_j = rate_k
            for m in range(k + 1, j + 1):
                rate_j += x[QD, m]
            sine, cosine = sine_cosine(x[THETA, k] - x[THETA, j])
            c, s = R * cosine, R * sine
            # On link k acts + s theta_j'^2, on link j - s theta_k'^2; joints up to k carry both.
            for a in range(j + 1):
                if a <= k:
                    out[TORQUE, a] -= s * rate_j * rate_j
                out[TORQUE, a] += s * rate_k * rate_k
                for b in range(k + 1):
                    M[a, b] += c
                    M[b, a] += c


@dataclass(frozen=True)
class Inertia(Term):
    """T = 1/2 sum_ij R_ij cos(theta_i - theta_j) theta_i' theta_j' (docs/n-joints.md).

    In absolute angles the torque on link k is sum_j R_kj [cos(theta_k - theta_j) theta_j'' +
    sin(theta_k - theta_j) theta_j'^2]; joint i carries the links i..N, so tau_i sums k >= i.
    For N = 2, R11 = M1 - M2, R22 = M2: this is Sakai and Maeshima's M(q) q'' + h with h
    already a torque.
    """

    name: ClassVar[str] = "inertia"
    kernel: ClassVar[Kernel] = _inertia

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return M1 | M1 M2 R12 | R_ij."""
        names = inertia_names(len(rig.joints))
        return tuple(Coefficient(name, rig.unit_of_parameter(name), "mechanical") for name in names)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the torque columns of every inertia parameter."""
        N = signals.joints
        # Sums over joints as a loop: along an axis of two or three, numpy's sums take longer.
        rate, acceleration = (list(itertools.accumulate(x.T)) for x in (signals.qd, signals.qdd))
        innermost = min(signals.excited_joints, default=N)  # carries the links beyond
        coupling: dict[tuple[int, int], Array] = {(k, k): acceleration[k] for k in range(N)}
        for k, j in itertools.combinations(range(N), 2):
            if j < innermost:
                continue
            turn = signals.theta[:, k] - signals.theta[:, j]
            c, s = np.cos(turn), np.sin(turn)
            coupling[j, k] = c * acceleration[k] - s * rate[k] ** 2
            if k >= innermost:
                coupling[k, j] = c * acceleration[j] + s * rate[j] ** 2
        out: Columns = {equation("torque", i): {} for i in signals.excited_joints}
        for weights, coefficient in zip(inertia_map(N), self.coefficients(rig), strict=True):
            pairs = list(map(tuple, np.argwhere(weights)))
            for i in signals.excited_joints:
                carried = [weights[k, j] * coupling[k, j] for k, j in pairs if k >= i]
                if carried:
                    total = functools.reduce(np.add, carried)
                    out[equation("torque", i)][coefficient.parameter] = total
        return out

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the matrix R, flattened."""
        return chain_matrix(values, len(rig.joints)).ravel()


def inertia_map(joints: int) -> Array:
    """Return dR/dparameter (parameters, N, N) of the symmetric R for each inertia parameter."""
    names = inertia_names(joints)
    weights = np.zeros((len(names), joints, joints))
    if joints == 2:
        weights[0, 0, 0] = 1.0  # M1 = R11 + R22
        weights[1] = np.diag([-1.0, 1.0])  # M2 = R22
        weights[2, 0, 1] = weights[2, 1, 0] = 1.0
        return weights
    index = 0
    for i in range(joints):
        for j in range(i, joints):
            weights[index, i, j] = weights[index, j, i] = 1.0
            index += 1
    return weights


def chain_matrix(values: Mapping[str, float], joints: int) -> Array:
    """Return the symmetric matrix R (N, N) [kg m^2] of named inertia parameters."""
    vector = np.array([values[name] for name in inertia_names(joints)])
    return np.asarray(np.tensordot(vector, inertia_map(joints), axes=1))


def mass_matrix(R: Array, q: Array) -> Array:
    """Return M(q) (N, N) [kg m^2]: M_ij = sum_{k>=i, l>=j} R_kl cos(theta_k - theta_l)."""
    theta = np.cumsum(q)
    turned = R * np.cos(theta[:, None] - theta[None, :])
    partial = np.cumsum(turned[::-1, ::-1], axis=0).cumsum(axis=1)
    return np.asarray(partial[::-1, ::-1])


def _one_per_joint(rig: Rig, stem: str) -> tuple[Coefficient, ...]:
    """Return the torque rows' coefficients of the joints, named `stem`1 .. `stem`N."""
    names = (f"{stem}{i}" for i in range(1, len(rig.joints) + 1))
    return tuple(Coefficient(name, rig.unit_of_parameter(name), "mechanical") for name in names)


@kernel
def _viscous_friction(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        for i in range(x.shape[1]):
            out[TORQUE, i] -= par[i] * x[QD, i]


@dataclass(frozen=True)
class ViscousFriction(Term):
    """Torque Fv_i q_i' against the motion of joint i (Sakai and Maeshima, section II)."""

    name: ClassVar[str] = "viscous_friction"
    kernel: ClassVar[Kernel] = _viscous_friction

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return Fv_1 .. Fv_N [N m s/rad]."""
        return _one_per_joint(rig, "Fv")

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return q_i' in the rows of joint i."""
        return {
            equation("torque", i): {f"Fv{i + 1}": signals.qd[:, i]} for i in range(signals.joints)
        }


@kernel
def _gravity(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase != CONTRIBUTE:
        return
    carried = 0.0
    for i in range(x.shape[1] - 1, -1, -1):
        carried += par[i] * sine_cosine(x[THETA, i])[0]
        out[TORQUE, i] -= carried


@dataclass(frozen=True)
class Gravity(Term):
    """V = - sum_k W_k g cos(theta_k): joint i carries sum_{k>=i} W_k g sin(theta_k)."""

    name: ClassVar[str] = "gravity"
    kernel: ClassVar[Kernel] = _gravity

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_1 .. W_N [kg m]."""
        return _one_per_joint(rig, "W")

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return g sin(theta_k) in the rows of joints 1 .. k."""
        weight = rig.gravity * np.sin(signals.theta)
        return {
            equation("torque", i): {f"W{k + 1}": weight[:, k] for k in range(i, signals.joints)}
            for i in range(signals.joints)
        }

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return W_k g [N m]."""
        return np.array([rig.gravity * values[c.parameter] for c in self.coefficients(rig)])


@kernel
def _inclined_gravity(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
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

    Link k exerts W_k g sin(theta_k + alpha) = g [W_k cos(alpha) sin(theta_k) + W_k sin(alpha)
    cos(theta_k)]: linear in 2 N unknowns that share alpha. `reduction` maps them to the N + 1
    parameters (docs/n-joints.md; the common parameter of Sakai and Maeshima's last claim).
    """

    name: ClassVar[str] = "inclined_gravity"
    kernel: ClassVar[Kernel] = _inclined_gravity

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_k cos(alpha), then W_k sin(alpha) [kg m]."""
        names = _linear_names(len(rig.joints))
        return tuple(Coefficient(name, "kg*m", "mechanical") for name in names)

    def parameters(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return W_1 .. W_N [kg m] and alpha [rad]."""
        weights = (f"W{i}" for i in range(1, len(rig.joints) + 1))
        named = tuple(Coefficient(name, "kg*m", "mechanical") for name in weights)
        return (*named, Coefficient(INCLINATION, "rad", "mechanical"))

    def reduction(self, rig: Rig) -> ParameterReduction:
        """Return x = (W cos(alpha), W sin(alpha)) of p = (W, alpha), W positive in sum."""
        N = len(rig.joints)

        def start(x: Array) -> Array:
            # (W, alpha) and (-W, alpha + pi) give equal torques; a positive sum of W is chosen.
            alpha = math.atan2(float(x[N:].sum()), float(x[:N].sum()))
            return np.append(x[:N] * math.cos(alpha) + x[N:] * math.sin(alpha), alpha)

        def value(p: Array) -> Array:
            return np.concatenate((p[:N] * math.cos(p[N]), p[:N] * math.sin(p[N])))

        def slope(p: Array) -> Array:
            c, s, eye = math.cos(p[N]), math.sin(p[N]), np.eye(N)
            by_angle = np.concatenate((-p[:N] * s, p[:N] * c))
            return np.column_stack((np.vstack((c * eye, s * eye)), by_angle))

        names = tuple(c.parameter for c in self.parameters(rig))
        return ParameterReduction(_linear_names(N), names, start, value, slope)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return g sin(theta_k) and g cos(theta_k) in the rows of joints 1 .. k."""
        N = signals.joints
        names = _linear_names(N)
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
        return np.array([*weights, values[INCLINATION]])


def _linear_names(joints: int) -> tuple[str, ...]:
    each = range(1, joints + 1)
    return (*(f"W{i} cos" for i in each), *(f"W{i} sin" for i in each))


TERMS = (Inertia, ViscousFriction, Gravity, InclinedGravity)
