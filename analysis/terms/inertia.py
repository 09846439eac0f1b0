"""Inertia of a planar chain of N links."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

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
    Term,
    equation,
    kernel,
)
from analysis.terms.sine_cosine import sine_cosine
from rig.model.parameters import inertia_names
from rig.model.rig import Rig


@kernel
def _kernel(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
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
            # Link k feels + s theta_j'^2, link j feels - s theta_k'^2; joints below carry both.
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
    kernel: ClassVar[Kernel] = _kernel

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return M1 | M1 M2 R12 | R_ij."""
        names = inertia_names(len(rig.joints))
        return tuple(Coefficient(name, rig.unit_of_parameter(name), "mechanical") for name in names)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the torque columns of every inertia parameter."""
        N = signals.joints
        # Sums over joints as a loop: along an axis of two or three, numpy's sums take longer.
        rate, acceleration = _running(signals.qd.T), _running(signals.qdd.T)
        lowest = min(signals.excited_joints, default=N)  # its torque carries links from here on
        feels: dict[tuple[int, int], Array] = {(k, k): acceleration[k] for k in range(N)}
        for k, j in itertools.combinations(range(N), 2):
            if j < lowest:
                continue
            turn = signals.theta[:, k] - signals.theta[:, j]
            c, s = np.cos(turn), np.sin(turn)
            feels[j, k] = c * acceleration[k] - s * rate[k] ** 2
            if k >= lowest:
                feels[k, j] = c * acceleration[j] + s * rate[j] ** 2
        out: Columns = {equation("torque", i): {} for i in signals.excited_joints}
        for weights, coefficient in zip(inertia_map(N), self.coefficients(rig), strict=True):
            pairs = list(map(tuple, np.argwhere(weights)))
            for i in signals.excited_joints:
                carried = [weights[k, j] * feels[k, j] for k, j in pairs if k >= i]
                if carried:
                    total = functools.reduce(np.add, carried)
                    out[equation("torque", i)][coefficient.parameter] = total
        return out

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the matrix R, flattened."""
        return chain_matrix(values, len(rig.joints)).ravel()


def _running(parts: Iterable[Array]) -> list[Array]:
    """Return the running sums of arrays (n,): the first, the first two, and so on."""
    return list(itertools.accumulate(parts))


def inertia_map(joints: int) -> Array:
    """Return (parameters, N, N): coefficients of each inertia parameter in the symmetric R."""
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
    """Return M(q) (N, N) of the chain: M_ij = sum_{k>=i, l>=j} R_kl cos(theta_k - theta_l)."""
    theta = np.cumsum(q)
    turned = R * np.cos(theta[:, None] - theta[None, :])
    partial = np.cumsum(turned[::-1, ::-1], axis=0).cumsum(axis=1)
    return np.asarray(partial[::-1, ::-1])


TERMS = (Inertia,)
