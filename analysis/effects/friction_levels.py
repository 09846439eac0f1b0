"""Dry friction whose level depends on the direction of motion or on the chamber pressures.

The contact's law is that of `contact`, with a level that changes along the path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Shape, out_of_range
from analysis.effects.contact import (
    FASTEST,
    NORMAL,
    contact_levels,
    contact_under_load,
    mean_sign,
    slide,
)
from analysis.effects.friction import Friction, fall_with_speed, force_limit, force_unit
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    P_CAP,
    P_ROD,
    SD,
    TORQUE,
    Coefficient,
    Columns,
    G,
    kernel,
)
from rig.model.rig import Rig

DIFFERENCE: Final = 0.1  # of the mean level: with a smaller difference it is not asymmetric
LEAST_SHARE: Final = 0.02  # of the other level: below, friction acts in one direction only
SUM: Final = 1.0  # weight of the rod pressure in the load where each seal has one pressure
DIFFERENCE_LOAD: Final = -1.0  # the same where the difference presses the piston's seal
ALIKE: Final = 0.5  # share of the rod's seals where both chambers press alike
UNLIKE: Final = (0.3, 0.7)  # shares from which a search of it begins
ONE_CHAMBER: Final = 1e-3  # the same, or its complement, where one chamber presses alone


@kernel
def _asymmetric(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # The hidden state is the force over the sum of both levels, times the first distance [m].
    if phase == CONTRIBUTE:
        i = int(par[0])
        v = x[SD, i]
        if par[3] <= 0.0:
            state = mean_sign(v, par[5], par[6])
            out[TORQUE, i] -= (par[1] if state > 0.0 else par[2]) * x[G, i] * state
            return
        scale = (par[1] + par[2]) / par[3]
        level, distance = (par[1], par[3]) if v > 0.0 else (-par[2], par[4])
        relax = abs(v) / distance
        dz[0] = relax * (level / scale - z[0]) / (1.0 + relax / FASTEST)
        out[TORQUE, i] -= scale * z[0] * x[G, i]


@dataclass(frozen=True)
class AsymmetricFriction(Friction):
    """F_f = F_ext a - F_ret r: friction levels that differ by direction.

    Each level builds up over its presliding distance while the piston moves in its direction, and
    decays over the other's while it moves back (the law of `contact`, by direction): extending
    da/ds = (1 - a)/d_ext, dr/ds = -r/d_ext; retracting, over the travel |s|, da = -a/d_ret,
    dr = (1 - r)/d_ret. Source: Jelali and Kroll 2003 (levels by direction).
    On an electric joint, which has no lever arm, it equals `coulomb_friction` of (F_ext + F_ret)/2
    with a `torque_offset` of (F_ext - F_ret)/2 while it slides, and is reported as these two.
    """

    hydraulic = True
    tailed = True
    name = "asymmetric_friction"
    smallest_coefficients = (30.0, 10.0)  # [N] either way
    variable = "the direction of the piston's motion"
    confounders = (
        "coulomb_friction", "torque_offset", "sensor_offset", "sensor_gain", "base_inclination",
    )  # fmt: skip
    includes = ("coulomb_friction",)  # where both levels are equal
    separated_by = (
        "motion about several places of the stroke: an offset torque does not change with G"
    )
    kernel = _asymmetric

    def _names(self) -> tuple[str, str]:
        return f"F_ext_{self.joint + 1}", f"F_ret_{self.joint + 1}"

    def distance_names(self) -> tuple[str, ...]:
        """Name the presliding distances of the two directions."""
        return f"presliding_ext_{self.joint + 1}", f"presliding_ret_{self.joint + 1}"

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return F_ext, F_ret [N]."""
        unit = force_unit(rig, self.joint)
        return tuple(Coefficient(name, unit, "mechanical") for name in self._names())

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G a and -G r."""
        lever = signals.G[:, self.joint]
        a, r = self._shares(rig, signals, shape)
        return self.row(dict(zip(self._names(), (lever * a, -lever * r), strict=True)))

    def _shares(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> tuple[Array, Array]:
        """Return the shares a, r (n,) of the two levels along the measured path."""
        if self.remembers(shape):
            a, r = contact_levels(self.path(signals, ()), shape[0], shape[1])
            return a, r
        z = self.contact(rig, signals, shape)
        size = self.size(signals, z, shape)
        return 0.5 * (size + z), 0.5 * (size - z)

    def deflection(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the force over the sum of both levels, times the first distance (n,) [m]."""
        a, r = self._shares(rig, signals, shape)
        extending, retracting = (values[name] for name in self._names())
        force = extending * a - retracting * r
        return np.asarray(shape[0] * force / (extending + retracting))

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint (0-based), levels, distances (0 for none), transition speed and tail."""
        linear = [values[name] for name in self._names()]
        distances = shape[:2] if len(shape) else (0.0, 0.0)
        contact = (*distances, self.contact_of(shape)[2], self.tail_of(shape))
        return np.array([self.joint, *linear, *contact])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative or too large level, a fall with speed, levels that hardly differ."""
        limit = force_limit(rig, self.joint)
        levels = [values[name] for name in self._names()]
        least = LEAST_SHARE * max(map(abs, levels))
        for name, level in zip(self._names(), levels, strict=True):
            too_large = out_of_range(name, level, "N", limit, least)
            if too_large:
                return too_large
        if self.simpler_equivalent(rig, values):
            return "the two directions differ by less than a tenth: this is coulomb_friction"
        return fall_with_speed(rig, self.joint, values, 0.5 * sum(levels))

    def simpler_equivalent(self, rig: Rig, values: Mapping[str, float], times: float = 1.0) -> str:
        """Return Coulomb friction where the levels differ by less than `DIFFERENCE` of the mean."""
        extending, retracting = (values[name] for name in self._names())
        equal = abs(extending - retracting) < times * DIFFERENCE * 0.5 * (extending + retracting)
        return "coulomb_friction" if equal else ""

    def distinct(self, intervals: Mapping[str, tuple[float, float]]) -> bool:
        """Return whether the intervals of both levels have no value in common."""
        extending, retracting = (intervals[name] for name in self._names())
        return extending[1] < retracting[0] or retracting[1] < extending[0]


@kernel
def _by_pressure(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # The hidden state is w times d over p_S [m], at a constant distance z d.
    if phase == CONTRIBUTE:
        i = int(par[0])
        v, load = x[SD, i], abs(par[6] * x[P_CAP, i] + par[7] * x[P_ROD, i])
        if par[2] <= 0.0 or par[5] <= 0.0:
            state, dz[0] = slide(v, z[0], par[2], par[3], par[4], NORMAL)
            out[TORQUE, i] -= par[1] * load * x[G, i] * state
            return
        stiffness = par[5] / par[2]
        pace = 1.0 + par[3] * abs(v)
        relax = abs(v) * stiffness / max(load, 1.0)
        dz[0] = pace * (v - relax * z[0]) / (1.0 + pace * relax / FASTEST)
        out[TORQUE, i] -= par[1] * stiffness * z[0] * x[G, i]


@dataclass(frozen=True)
class PressureDependentFriction(Friction):
    """F_f = k w: seals pressed on by the chamber pressures (Jelali and Kroll 2003).

    k [m^2] is the friction coefficient times the seals' area under pressure. The load is
    p = |p_cap + a p_rod|: the sum where each seal has one chamber's pressure on it (a = 1), the
    difference where the piston's seal has both (a = -1). Where seals of unlike coefficients have
    one pressure each, p = 2 ((1 - r) p_cap + r p_rod) with the rod's share r of both coefficients
    (Bonchis et al. 1999). Either w [Pa] builds up to p at a contact stiffness that does not depend
    on it, only on speed (`contact`):
    dw/ds = (1 + k_s |s'|) (p_S / d) (sign(s') - w / p), d the presliding distance at supply
    pressure, k_s the stiffening; or within a distance d that does not: w = p z, dz/ds =
    (sign(s') - z) / d.
    """

    hydraulic = True
    name = "pressure_dependent_friction"
    smallest_coefficients = (5e-6,)  # [m^2]
    stiffens = True
    shapes_after = 3
    variable = "the chamber pressures, with the velocity's sign"
    confounders = ("coulomb_friction", "asymmetric_friction")
    separated_by = (
        "the same motion at two levels of chamber pressure (supply setting, load or inclination)"
    )
    kernel = _by_pressure

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return k [m^2]."""
        return (Coefficient(f"k_friction_{self.joint + 1}", "m^2", "mechanical"),)

    def shape_names(self) -> tuple[str, ...]:
        """Name the contact's shapes, the rod's weight, the constant distance, the rod's share."""
        joint = self.joint + 1
        own = (f"rod_weight_{joint}", f"constant_distance_{joint}", f"rod_share_{joint}")
        return (*super().shape_names(), *own)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the contact's shapes, the rod's weight, the constant distance, the rod's share.

        A shape without the last three is that of the sum, at a constant stiffness.
        """
        weight, constant, share = self.shape_names()[-3:]
        ends = ONE_CHAMBER, 1.0 - ONE_CHAMBER
        return (
            *super().shapes(rig),
            Shape(weight, "1", DIFFERENCE_LOAD, SUM, (DIFFERENCE_LOAD,), detail=True, fixed=True),
            Shape(constant, "1", 1.0, 1.0, (1.0,), detail=True, fixed=True),
            Shape(share, "", *ends, (ALIKE,), resolution=True, saturates=True, detail=True),
        )

    def further_points(self, rig: Rig) -> tuple[tuple[float, ...], ...]:
        """Return a contact with memory under the difference, and under one chamber's pressure."""
        (distance,) = self.shape_of(rig, ())
        contact = (distance, 0.0, 0.0)
        one_chamber = ((*contact, SUM, 0.0, r) for r in (ONE_CHAMBER, 1.0 - ONE_CHAMBER))
        return ((*contact, DIFFERENCE_LOAD), *one_chamber)

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape with a stiffening, or with a share of the rod's seals, under the sum."""
        weight, constant, share = self._load_form(shape)
        if weight != SUM or share != ALIKE:
            return (tuple(shape),)
        stiffened = () if len(shape) > 3 else super().detailed_shapes(rig, shape)
        contact = (*shape, 0.0, 0.0)[:3]
        return (*stiffened, *((*contact, SUM, constant, unlike) for unlike in UNLIKE))

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the contact without memory or at a constant distance, and another load."""
        distance, _, speed = self.contact_of(shape)
        memory = (distance, 0.0, 0.0) if self.remembers(shape) else (0.0, 0.0, speed)
        weight, constant, share = self._load_form(shape)
        forms: tuple[tuple[float, ...], ...] = ()
        if self.remembers(shape) and not constant:
            forms = (*super().other_form_starts(rig, shape), (*memory, weight, 1.0, *shape[5:]))
        if weight == DIFFERENCE_LOAD:
            return (*forms, (*memory, SUM, constant, ALIKE))
        return (*forms, (*memory, DIFFERENCE_LOAD, constant)) if share == ALIKE else forms

    def coefficients_comparable(self, shape: Sequence[float], other: Sequence[float]) -> bool:
        """Return whether both shapes weight the pressures alike."""
        one, two = (self._load_form(s) for s in (shape, other))
        return (one[0], one[2]) == (two[0], two[2])

    def _load_form(self, shape: Sequence[float]) -> tuple[float, float, float]:
        """Return the rod pressure's weight, 1 for a constant distance, the rod's share."""
        weight, constant, share = (*shape[3:], *(SUM, 0.0, 0.0)[len(shape[3:]) :])
        return weight, constant, share or ALIKE

    def _weights(self, shape: Sequence[float]) -> tuple[float, float]:
        """Return the weights of the cap and the rod pressure in the load."""
        weight, _, share = self._load_form(shape)
        return 2.0 * (1.0 - share), 2.0 * share * weight

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G w."""
        i = self.joint
        if self.remembers(shape) and not self._load_form(shape)[1]:
            path = self.deflection(rig, signals, {}, shape)
            level = path * rig.supply.pressure / shape[0]
        else:
            level = self._load(signals, shape) * self.contact(rig, signals, shape)
        return self.row({f"k_friction_{i + 1}": signals.G[:, i] * level})

    def _load(self, signals: Signals, shape: Sequence[float]) -> Array:
        """Return the load (n,) [Pa] of both chamber pressures."""
        i, (cap, rod) = self.joint, self._weights(shape)
        return np.asarray(np.abs(cap * signals.p_cap[:, i] + rod * signals.p_rod[:, i]))

    def deflection(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return w d / p_S (n,) [m], at a constant distance z d."""
        if self._load_form(shape)[1]:
            return super().deflection(rig, signals, values, shape)
        stiffness = rig.supply.pressure / shape[0]
        path = self.path(signals, shape)
        return np.asarray(
            contact_under_load(path, self._load(signals, shape), stiffness) / stiffness
        )

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint (0-based), k, distance, stiffening, transition speed, p_S, both weights.

        At a constant distance 0 for p_S.
        """
        k = values[f"k_friction_{self.joint + 1}"]
        pressure = 0.0 if self._load_form(shape)[1] else rig.supply.pressure
        contact, weights = self.contact_of(shape), self._weights(shape)
        return np.array([self.joint, k, *contact, pressure, *weights])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject negative friction, a fall with speed, and over half of the cylinder's force."""
        k = values[name := f"k_friction_{self.joint + 1}"]
        falls = fall_with_speed(rig, self.joint, values, k * rig.supply.pressure)
        half_area = 0.5 * rig.joints[self.joint].cylinder.cap_area
        return falls or out_of_range(name, k, "m^2", half_area)


TERMS = (AsymmetricFriction, PressureDependentFriction)
