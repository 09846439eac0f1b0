"""Effects on the arm: an inclined base, a spring, a constant torque, a mass at its tip."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.constants import g as standard_gravity

from analysis.effects.base import Array, Effect, Shape, SignalEffect, out_of_range
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    PREPARE,
    QD,
    THETA,
    TORQUE,
    Coefficient,
    Columns,
    Q,
    equation,
    kernel,
)
from analysis.terms.mechanics import Gravity, Inertia, inertia_map
from analysis.terms.sine_cosine import sine_cosine
from rig.model.electric import UNKNOWN
from rig.model.parameters import inertia_names
from rig.model.rig import Rig


def torque_limit(rig: Rig, joint: int) -> float:
    """Return half of the largest torque of the joint's cylinder (at mid-stroke) or drive [N m]."""
    _, lever, _ = rig.joints[joint].geometry(0.0)
    return 0.5 * abs(float(lever)) * rig.largest_force(joint)


@kernel
def _inclination(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        for i in range(x.shape[1]):
            x[THETA, i] += par[0]


@dataclass(frozen=True)
class BaseInclination(SignalEffect):
    """All absolute angles turned by one angle alpha: link k pulls W_k g sin(theta_k + alpha).

    Inertia depends on differences of absolute angles only, so that turning them changes gravity
    alone (docs/n-joints.md); W_k cos(alpha) and W_k sin(alpha) share one alpha, which is therefore
    a shape and not N linear unknowns.
    """

    mechanism = "gravity"
    element = "base"
    name = "base_inclination"
    exact = True
    smallest_shape = (0.017,)  # [rad]
    prepares = True
    family = "mechanics"
    alters = ("mechanical",)
    variable = "the cosine of the absolute angles"
    quantity = "absolute angle"
    confounders = ("torque_offset", "joint_spring", "sensor_offset")
    separated_by = "slow motion of every joint over its whole stroke at several poses of the others"
    shape_stems = ("inclination",)
    kernel = _inclination

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return the bench, where gravity acts and the rig does not estimate the inclination."""
        unknown = getattr(rig, "inclination", 0.0) == UNKNOWN
        return () if getattr(rig, "prismatic", False) or unknown or rig.gravity == 0 else ("bench",)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return alpha [rad], up to 45 degrees either way."""
        grid = (-0.4, -0.1, -0.02, 0.02, 0.1, 0.4)
        return (Shape("inclination", "rad", -STEEPEST, STEEPEST, grid, 0.0),)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Turn the absolute angles."""
        return replace(signals, theta=signals.theta + self.shape_of(rig, shape)[0])


STEEPEST: Final = math.pi / 4  # [rad] inclination of a base
LEAST_REACH: Final = 0.1  # of the joint's range that half its torque must move it: else too stiff
RESTS: Final = 5  # rest angles to start from, evenly in the joint's range
PRELOAD: Final = 8.0  # ranges of the joint: a long gas spring changes its force by a tenth over it


@kernel
def _spring(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        out[TORQUE, i] -= par[1] * (x[Q, i] - par[2])


@dataclass(frozen=True)
class JointSpring(Effect):
    """Torque k (q - rest) back to the rest angle (a hose, a counterweight's spring): Hooke.

    The rest angle is a shape; where the records do not determine it, mid-stroke is used.
    """

    mechanism = "position_force"
    name = "joint_spring"
    smallest_coefficients = (20.0,)  # [N m/rad]
    family = "mechanics"
    variable = "the joint's angle"
    quantity = "joint position"
    confounders = ("torque_offset", "base_inclination", "sensor_offset")
    includes = ("torque_offset",)  # at a rest angle far away
    separated_by = (
        "slow motion over the whole stroke at two poses of the other joints: gravity "
        "depends on the absolute angle, the spring on the joint's angle"
    )
    shape_stems = ("rest",)
    kernel = _spring
    where: str = "joint 1"

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return k [N m/rad]."""
        return (Coefficient(f"k_spring_{self.joint + 1}", "N*m/rad", "mechanical"),)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the rest angle [rad], up to `PRELOAD` times the joint's range beyond its ends.

        A preloaded spring rests outside the range. Several starts are tried: from far away a
        search ends at a negative stiffness.
        """
        low, high = _reach(rig, self.joint)
        reach = high - low
        inside = map(float, np.linspace(low, high, RESTS + 2)[1:-1])
        starts = (low - 0.5 * reach, *inside, high + 0.5 * reach)
        ends = low - PRELOAD * reach, high + PRELOAD * reach
        return (Shape(f"rest_{self.joint + 1}", "rad", *ends, starts),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return q - rest."""
        rest = self.shape_of(rig, shape)[0]
        column = signals.q[:, self.joint] - rest
        return {equation("torque", self.joint): {f"k_spring_{self.joint + 1}": column}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, k, rest."""
        k = values[f"k_spring_{self.joint + 1}"]
        return np.array([self.joint, k, self.shape_of(rig, shape)[0]])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative stiffness, one too stiff to move, a rest angle far out of range."""
        name = f"k_spring_{self.joint + 1}"
        low, high = _reach(rig, self.joint)
        stiffest = torque_limit(rig, self.joint) / (LEAST_REACH * (high - low))
        return out_of_range(name, values[name], "N*m/rad", stiffest) or self.outside(rig, shape)


def _reach(rig: Rig, joint: int) -> tuple[float, float]:
    """Return the joint's smallest and largest angle."""
    part = rig.joints[joint]
    ends = [float(part.geometry(end)[0]) for end in part.position_range]
    return min(ends), max(ends)


@kernel
def _torque(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        out[TORQUE, int(par[0])] -= par[1]


@dataclass(frozen=True)
class TorqueOffset(Effect):
    """A constant torque T on the joint, positive where it opens it: M q'' + ... = G F + T.

    Of an electric joint the benchmark's sign and name are kept: M q'' + ... + offset = torque.
    """

    mechanism = "position_force"
    name = "torque_offset"
    exact = True
    smallest_coefficients = (2.0,)  # [N m]
    family = "mechanics"
    variable = "nothing: it is constant"
    quantity = "joint position"
    confounders = ("asymmetric_friction", "base_inclination", "joint_spring", "sensor_offset")
    separated_by = (
        "slow motion over the whole stroke: torques of gravity, a spring and a pressure's offset "
        "change with it"
    )
    kernel = _torque
    where: str = "joint 1"

    def _name(self, rig: Rig) -> tuple[str, float]:
        if rig.electric:
            return f"offset{self.joint + 1}", 1.0
        return f"T_offset_{self.joint + 1}", -1.0

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return T [N m] (electric: offset, N or N m)."""
        unit = str(getattr(rig.joints[self.joint], "force_unit", "N*m"))
        return (Coefficient(self._name(rig)[0], unit, "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return -1: the offset is on the drive's side (electric: +1)."""
        name, sign = self._name(rig)
        return {equation("torque", self.joint): {name: np.full(len(signals.t), sign)}}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint and the torque on the load's side."""
        name, sign = self._name(rig)
        return np.array([self.joint, sign * values[name]])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject more than half of the drive's torque."""
        name = self._name(rig)[0]
        limit = torque_limit(rig, self.joint)
        return out_of_range(name, values[name], "N*m", limit, -limit)


@kernel
def _payload(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # The tip's Jacobian to joint i is the sum of l_k (cos, sin)(theta_k) over links k >= i; its
    # acceleration at rest of the joints is the sum of l_k theta_k'^2 (-sin, cos)(theta_k).
    if phase != CONTRIBUTE:
        return
    N = x.shape[1]
    m, g = par[0], par[1]
    ax, ay, rate = 0.0, 0.0, 0.0
    for k in range(N):
        rate += x[QD, k]
        sine, cosine = sine_cosine(x[THETA, k])
        ax -= par[2 + k] * rate * rate * sine
        ay += par[2 + k] * rate * rate * cosine
    jx_i, jy_i = 0.0, 0.0
    for i in range(N - 1, -1, -1):
        sine, cosine = sine_cosine(x[THETA, i])
        jx_i += par[2 + i] * cosine
        jy_i += par[2 + i] * sine
        # theta = 0 hangs straight down: the tip's height grows by jy per unit of angle.
        out[TORQUE, i] -= m * (jx_i * ax + jy_i * (ay + g))
        jx_j, jy_j = 0.0, 0.0
        for j in range(N - 1, -1, -1):
            sine, cosine = sine_cosine(x[THETA, j])
            jx_j += par[2 + j] * cosine
            jy_j += par[2 + j] * sine
            M[i, j] += m * (jx_i * jx_j + jy_i * jy_j)


@dataclass(frozen=True)
class Payload(Effect):
    """A point mass m at the tip: R_ij grows by m l_i l_j, W_i by m l_i.

    Its columns are a sum of the baseline's own, so M, R and W of records that all carry it absorb
    it COMPLETELY: no excitation of them shows it. It is found only against a reference: records
    that are known to be without it (`Signals.loaded`), where it has no columns, or a model
    identified without it, whose M, R and W are held.
    """

    mechanism = "gravity"
    element = "load"
    name = "payload"
    exact = True
    family = "mechanics"
    variable = "gravity and inertia alike"
    quantity = "absolute angle"
    confounders = ()
    separated_by = (
        "records with and without the payload, or a model identified without it as reference"
    )
    kernel = _payload

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return the bench, where it has links."""
        return () if getattr(rig, "prismatic", False) else ("bench",)

    def absorbed(self, rig: Rig) -> str:
        """Return that the baseline's M, R and W absorb it."""
        return (
            "M, R and W of records that all carry the same payload absorb it completely; compare "
            "with records without it"
        )

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return m [kg]."""
        return (Coefficient("m_payload", "kg", "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the columns of inertia and gravity summed by `growth`; none without payload."""
        if signals.loaded is False:
            return {}
        weights = growth(rig)
        out: Columns = {}
        for term in (Inertia(), Gravity()):
            for row, columns in term.columns(rig, signals, ()).items():
                total = sum(weights[p] * column for p, column in columns.items())
                entry = out.setdefault(row, {"m_payload": np.zeros(len(signals.t))})
                entry["m_payload"] = entry["m_payload"] + total
        return out

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return m, g and the links' lengths."""
        return np.array([values["m_payload"], rig.gravity, *(j.link_length for j in rig.joints)])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative mass, and one that no joint can lift."""
        return out_of_range("m_payload", values["m_payload"], "kg", heaviest_payload(rig))


def heaviest_payload(rig: Rig) -> float:
    """Return the largest mass [kg] that a joint can lift at its link's end, in mid-stroke."""
    # The limit is half of a joint's largest torque.
    lifted = (2.0 * torque_limit(rig, i) / j.link_length for i, j in enumerate(rig.joints))
    return float(max(lifted) / standard_gravity)


def growth(rig: Rig) -> dict[str, float]:
    """Return the increase of each mechanical parameter per kilogram at the tip."""
    lengths = np.array([j.link_length for j in rig.joints])
    names = inertia_names(len(lengths))
    # Of R = sum_k p_k E_k the coefficients are found by least squares on the disjoint patterns E.
    patterns = inertia_map(len(lengths)).reshape(len(names), -1)
    shares = np.linalg.lstsq(patterns.T, np.outer(lengths, lengths).ravel(), rcond=None)[0]
    weights = {f"W{i}": float(length) for i, length in enumerate(lengths, start=1)}
    return dict(zip(names, map(float, shares), strict=True)) | weights


TERMS = (BaseInclination, JointSpring, TorqueOffset, Payload)
