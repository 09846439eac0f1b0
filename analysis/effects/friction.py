"""Dry friction of a cylinder's seals, in four forms that act as a force on the piston.

Torque row of joint i (friction is on the load's side): ... + G F_f = G F. Every form is a level
[N] times the state z of the seal's contact (`contact`), -1 <= z <= 1, which reverses within a
presliding distance d of travel after each reversal (Dahl 1968; Jelali and Kroll 2003), a shorter
one at higher speed (stiffening k; of rubber: Ferry 1980):

    dz/ds = (1 + k |s'|) (sign(s') - z) / d

The piston's path alone decides z, so that the rows use the measured piston; the simulation
integrates the deflection y = d z [m] as a hidden state. A presliding distance of 0 means the
contact without memory, z = erf(s'/w) with the transition speed w (`TRANSITION` in a model without a
shape), or 2/pi atan(s'/w) of one level and of levels by direction. d, k and w are shape parameters;
the rows decide between a distance and a transition speed. Stribeck's and asymmetric friction have
k = 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from scipy.ndimage import maximum_filter1d

from analysis.effects.base import Array, Effect, Shape, out_of_range
from analysis.effects.contact import (
    CAUCHY,
    FASTEST,
    NORMAL,
    STIFFENING,
    TRANSITION,
    contact_range,
    contact_state,
    contact_under_load,
    memoryless,
    path_unit,
    presliding,
    slide,
    stiffened_path,
    stiffening,
    tail,
    transition,
)
from analysis.signals.conditioning import Signals
from analysis.signals.settings import SIGNALS
from analysis.terms.base import (
    CONTRIBUTE,
    SD,
    TORQUE,
    Coefficient,
    Columns,
    G,
    Used,
    equation,
    kernel,
)
from rig.model.rig import Rig

BREAKAWAY: Final = 0.1  # of the sliding level: a smaller one is an error of the contact's form
SMALLEST_FALL: Final = 1 / 3  # of the breakaway, up to the records' top speed: less is no Stribeck
SLOWEST_FALL: Final = 0.5  # Stribeck over top speed: above it the fall is a line within 7 % rms
SPEEDS: Final = 200  # points of the curve over speed in which the fall is computed
LEAST_LEVEL: Final = 1e-6  # of the breakaway, where it is negligible: prevents division by zero
GAUSSIAN, EXPONENTIAL = 2.0, 1.0  # exponents of the fall from breakaway


@dataclass(frozen=True)
class Friction(Effect):
    """Common parts of the four forms: joint, the contact's state z, with memory or without.

    Where the contact `stiffens` the stiffening is a detail: a shape without it does not stiffen. A
    shape with a transition speed has no memory, and 0 for distance and stiffening; where the
    contact is `tailed` it may state the tail of the spread. `shapes_before` and `shapes_after`
    count the shape parameters before and after those of the contact.
    """

    mechanism = "friction_curve"
    element = "piston"
    family = "friction"
    quantity = "velocity"
    stiffens: ClassVar[bool] = False
    tailed: ClassVar[bool] = False
    shapes_before: ClassVar[int] = 0
    shapes_after: ClassVar[int] = 0
    where: str = "joint 1"

    def distance_names(self) -> tuple[str, ...]:
        """Name the presliding distances."""
        return (f"presliding_{self.joint + 1}",)

    def shape_names(self) -> tuple[str, ...]:
        """Name distances, stiffening where the contact stiffens, transition speed and tail."""
        joint = self.joint + 1
        rate = (f"stiffening_{joint}",) if self.stiffens else ()
        spread = (f"tail_{joint}",) if self.tailed else ()
        return (*self.distance_names(), *rate, f"transition_{joint}", *spread)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return presliding distances [m], stiffening [s/m], transition speed [m/s] and tail.

        On an electric joint they are in its own unit.
        """
        joint = self.joint + 1
        rate = (stiffening(f"stiffening_{joint}"),) if self.stiffens else ()
        limits = contact_range(rig, self.joint)
        distances = (presliding(name, limits) for name in self.distance_names())
        spread = (tail(f"tail_{joint}"),) if self.tailed else ()
        return (*distances, *rate, transition(f"transition_{joint}", limits), *spread)

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape with a stiffening where the contact has a memory and can stiffen."""
        if self.stiffens and self.remembers(shape) and len(shape) == self.shapes_before + 1:
            return ((*shape, STIFFENING),)
        return (tuple(shape),)

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the contact without memory of a shape with one, else that of the other tail."""
        if not len(shape):
            return ()
        place = self._speed_index()
        if not self.remembers(shape):
            other = () if self.tail_of(shape) == CAUCHY else (CAUCHY,)
            return ((*shape[: place + 1], *other),) if self.tailed else ()
        no_memory = (0.0,) * (place - self.shapes_before)
        speed = contact_range(rig, self.joint).speed
        return ((*shape[: self.shapes_before], *no_memory, speed, *shape[place + 1 :]),)

    def _speed_index(self) -> int:
        """Return the index of the transition speed in a shape."""
        return len(self.shape_names()) - self.shapes_after - 1 - self.tailed

    def tail_of(self, shape: Sequence[float]) -> float:
        """Return the tail of the spread of a contact without memory, `NORMAL` if not given."""
        place = self._speed_index() + 1
        return shape[place] if self.tailed and len(shape) > place else NORMAL

    def remembers(self, shape: Sequence[float]) -> bool:
        """Return whether the contact has memory: a presliding distance above 0."""
        return len(shape) > self.shapes_before and shape[self.shapes_before] > 0.0

    def contact_of(self, shape: Sequence[float]) -> tuple[float, float, float]:
        """Return presliding distance [m], stiffening [s/m] and transition speed [m/s] of a shape.

        0, 0 and `TRANSITION` where they are not given.
        """
        contact = shape[self.shapes_before :]
        rate = contact[1] if self.stiffens and len(contact) > 1 else 0.0
        index = self._speed_index()
        speed = shape[index] if len(shape) > index else 0.0
        return (contact[0] if len(contact) else 0.0), rate, speed or TRANSITION

    def path(self, signals: Signals, shape: Sequence[float]) -> Array:
        """Return the path s_w (n,) [m] of the contact (`stiffened_path`)."""
        i = self.joint
        return stiffened_path(signals.path(i), signals.sd[:, i], self.contact_of(shape)[1])

    def tolerance(self, shape: Sequence[float]) -> float:
        """Return a finer tolerance without memory: with a coarser one, creep at rest is noise."""
        if self.remembers(shape):
            return self.rate_tolerance
        return 1e-3 * self.contact_of(shape)[2]

    def hidden(self, rig: Rig) -> int:
        """Return 1: the deflection y = d z."""
        return 1

    def fastest(self, shape: Sequence[float]) -> float:
        """Return the bound of the contact's relaxation [1/s]."""
        return FASTEST

    def hidden_path(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the deflection (n, 1) [m]; a contact without memory has none."""
        if not self.remembers(shape):
            return super().hidden_path(rig, signals, values, shape)
        return self.deflection(rig, signals, values, shape)[:, None]

    def deflection(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the deflection y (n,) [m] along the measured path, as the kernel integrates it."""
        return np.asarray(self.contact_of(shape)[0] * self.contact(rig, signals, shape))

    def contact(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Array:
        """Return z (n,) along the measured path."""
        distance, _, speed = self.contact_of(shape)
        if not self.remembers(shape):
            return memoryless(signals.sd[:, self.joint], speed, self.tail_of(shape))
        return np.asarray(contact_state(self.path(signals, shape), distance))

    def size(self, signals: Signals, z: Array, shape: Sequence[float]) -> Array:
        """Return |z| (n,) of `contact`, of a contact without memory at rest by its slow speed.

        The mean size of a noisy z is not 0 at rest: while the speed below 20 Hz stays below the
        transition speed, it takes the place of the speed.
        """
        if self.remembers(shape):
            return np.abs(z)
        slow, speed = signals.slow_speed(self.joint), self.contact_of(shape)[2]
        largest = maximum_filter1d(np.abs(slow), max(1, round(REST * signals.rate)))
        return np.abs(np.where(largest < speed, memoryless(slow, speed, self.tail_of(shape)), z))

    def over_speed(self, speed: Array, shape: Sequence[float]) -> Array:
        """Return z (n,) in steady motion at speeds (n,) [m/s] above 0."""
        if self.remembers(shape):
            return np.ones(len(speed))
        return memoryless(speed, self.contact_of(shape)[2], self.tail_of(shape))

    def row(self, columns: Mapping[str, Array]) -> Columns:
        """Return columns of the joint's torque row."""
        return {equation("torque", self.joint): dict(columns)}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint (0-based), coefficients, distance, stiffening, transition speed, tail."""
        linear = [values[c.parameter] for c in self.coefficients(rig)]
        contact = (*self.contact_of(shape), self.tail_of(shape))
        return np.array([self.joint, *linear, *contact], dtype=np.float64)


def force_limit(rig: Rig, joint: int) -> float:
    """Return half of the force of cylinder or drive [N]; more dry friction would stop the joint."""
    return 0.5 * rig.largest_force(joint)


def force_unit(rig: Rig, joint: int) -> str:
    """Return N; of a revolute electric joint N*m."""
    return str(getattr(rig.joints[joint], "force_unit", "N"))


REST: Final = 2.0 / SIGNALS.direction_cutoff  # [s] two of the slow speed's shortest periods
FAR_ABOVE: Final = 1e3  # of the speed limit: at it, a breakaway does not fall
LARGEST_FALL: Final = 0.5  # of the level, up to the speed limit: Coulomb's level is constant


def fall_with_speed(rig: Rig, joint: int, values: Mapping[str, float], level: float) -> str:
    """Return in words that a level [N] falls with speed beside negative viscous friction, or ''."""
    viscous = values.get(f"Fv{joint + 1}", 0.0) / float(rig.joints[joint].geometry(0.0)[1]) ** 2
    if viscous * rig.joints[joint].limits.speed < -LARGEST_FALL * abs(level):
        return "viscous friction would be negative: this level falls with speed"
    return ""


@kernel
def _coulomb(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        state, dz[0] = slide(x[SD, i], z[0], par[2], par[3], par[4], par[5])
        out[TORQUE, i] -= par[1] * x[G, i] * state


@dataclass(frozen=True)
class CoulombFriction(Friction):
    """F_f = Fc z: dry friction of one level (Coulomb 1785; the contact's state z, see the module).

    Without it the viscous friction is biased: 80 N on the seed bench make Fv2 110 % too large.
    """

    name = "coulomb_friction"
    smallest_coefficients = (15.0,)  # [N]
    stiffens = True
    tailed = True
    variable = "the sign of the piston's velocity"
    confounders = ("stribeck_friction", "asymmetric_friction", "pressure_dependent_friction")
    separated_by = (
        "the same motion at two speeds and at two levels of chamber pressure: its level is the same"
    )
    kernel = _coulomb

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return Fc [N]."""
        return (Coefficient(f"Fc{self.joint + 1}", force_unit(rig, self.joint), "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G z."""
        z = self.contact(rig, signals, shape)
        return self.row({f"Fc{self.joint + 1}": signals.G[:, self.joint] * z})

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject negative friction, a fall with speed, and more than half the cylinder's force."""
        name = f"Fc{self.joint + 1}"
        falls = fall_with_speed(rig, self.joint, values, values[name])
        return falls or out_of_range(name, values[name], "N", force_limit(rig, self.joint))


@kernel
def _stribeck(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # The hidden state is w times d [m].
    if phase == CONTRIBUTE:
        i = int(par[0])
        level = math.exp(-(abs(x[SD, i] / par[2]) ** par[5]))
        if par[3] > 0.0:
            level = max(level, LEAST_LEVEL)
        # At a constant stiffness the distance goes with the level.
        state, dz[0] = slide(x[SD, i], z[0], par[3] * level, 0.0, par[4], NORMAL)
        out[TORQUE, i] -= par[1] * level * x[G, i] * state


@dataclass(frozen=True)
class StribeckFriction(Friction):
    """F_f = Fs w: breakaway above Coulomb's level (Armstrong-Helouvry et al. 1994).

    The level e = exp(-|s'/vs|^n) falls off over the Stribeck speed vs (shape), with n = 2, or of a
    shape with an exponent n = 1 (Tustin 1947); w builds up to it at a contact stiffness that does
    not depend on it (Dahl 1968): dw/ds = (sign(s') - w / e) / d. Alone it is the part that vanishes
    with speed; together with `coulomb_friction` it is the whole Stribeck curve.
    """

    name = "stribeck_friction"
    smallest_coefficients = (30.0,)  # [N]
    variable = "the piston's velocity near zero"
    confounders = ("coulomb_friction", "asymmetric_friction")
    includes = ("coulomb_friction",)  # at a high Stribeck speed
    beside = True
    shapes_before = 1
    shapes_after = 1
    separated_by = (
        "slow sweeps through zero velocity beside fast ones: it is gone above the Stribeck speed"
    )
    kernel = _stribeck

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return Fs [N]."""
        return (Coefficient(f"Fs{self.joint + 1}", force_unit(rig, self.joint), "mechanical"),)

    def shape_names(self) -> tuple[str, ...]:
        """Name the Stribeck speed, presliding distance, transition speed and exponent."""
        joint = self.joint + 1
        return (f"v_stribeck_{joint}", *super().shape_names(), f"exponent_stribeck_{joint}")

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return Stribeck speed [m/s], presliding distance [m], transition speed [m/s], exponent.

        A shape without an exponent has n = 2.
        """
        stribeck_speed, *_, exponent_name = self.shape_names()
        speed = rig.joints[self.joint].limits.speed
        grid = (0.01 * speed, 0.03 * speed, 0.1 * speed)
        unit = f"{path_unit(rig, self.joint)}/s"
        falling = Shape(stribeck_speed, unit, 1e-3 * speed, 0.4 * speed, grid)
        exponent = Shape(
            exponent_name, "1", EXPONENTIAL, EXPONENTIAL, (EXPONENTIAL,), detail=True, fixed=True
        )
        return (falling, *super().shapes(rig), exponent)

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the contact without memory, and the fall with the other exponent."""
        falling, (distance, _, speed) = self.shape_of(rig, shape)[0], self.contact_of(shape)
        memory = (distance, 0.0) if self.remembers(shape) else (0.0, speed)
        exponent = () if shape[3:] else (EXPONENTIAL,)
        return (*super().other_form_starts(rig, shape), (falling, *memory, *exponent))

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G w."""
        if self.remembers(shape):
            w = self.deflection(rig, signals, {}, shape) / shape[1]
        else:
            level = self._level(rig, signals.sd[:, self.joint], shape)
            w = level * self.contact(rig, signals, shape)
        return self.row({f"Fs{self.joint + 1}": signals.G[:, self.joint] * w})

    def _level(self, rig: Rig, speed: Array, shape: Sequence[float]) -> Array:
        """Return exp(-|s'/vs|^n) (n,) of speeds s' (n,) [m/s]."""
        ratio = np.abs(speed) / self.shape_of(rig, shape)[0]
        return np.asarray(np.exp(-(ratio ** self._exponent(shape))))

    def _exponent(self, shape: Sequence[float]) -> float:
        return shape[3] if len(shape) > 3 else GAUSSIAN

    def deflection(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return w d (n,) [m]."""
        s = self.path(signals, ())
        level = self._level(rig, signals.sd[:, self.joint], shape)
        return np.asarray(shape[1] * contact_under_load(s, level, 1.0 / shape[1]))

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint (0-based), Fs, Stribeck speed, distance, transition speed, exponent."""
        force, falling = values[f"Fs{self.joint + 1}"], self.shape_of(rig, shape)[0]
        distance, _, speed = self.contact_of(shape)
        return np.array([self.joint, force, falling, distance, speed, self._exponent(shape)])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative, small or too large breakaway, and a Stribeck speed at its bounds.

        Below `BREAKAWAY` of Coulomb's level it is an error of the contact's form.
        """
        name = f"Fs{self.joint + 1}"
        force, level = values[name], values.get(f"Fc{self.joint + 1}", 0.0)
        if 0.0 < force < BREAKAWAY * level:
            return f"{name} = {force:.3g} N is {force / level:.1%} of the sliding level"
        too_large = out_of_range(name, force, "N", force_limit(rig, self.joint))
        return too_large or Effect.outside(self, rig, shape[:1])

    def without_fall(self, rig: Rig, shape: Sequence[float]) -> tuple[float, ...]:
        """Return the shape with a Stribeck speed far above the joint's limit."""
        return (FAR_ABOVE * rig.joints[self.joint].limits.speed, *shape[1:])

    def not_shown(
        self, rig: Rig, values: Mapping[str, float], shape: Sequence[float],
        terms: Sequence[Used], signals: Sequence[Signals],
    ) -> str:  # fmt: skip
        """Return the message where dry friction hardly falls up to the records' top speed.

        Two contacts of different transition speeds fit any smooth rising curve, and a fall over
        most of the speed range equals a constant level with other viscous friction.
        """
        i, unit = self.joint, f"{path_unit(rig, self.joint)}/s"
        top = max((float(np.abs(s.sd[:, i]).max()) for s in signals if s.excited[i]), default=0.0)
        if shape[0] > SLOWEST_FALL * top:
            return (
                f"Stribeck speed {shape[0]:.3g} {unit}, over {SLOWEST_FALL:.0%} of the records' "
                f"top speed {top:.3g} {unit}: viscous friction fits such a fall as well"
            )
        v = np.linspace(0.0, top, SPEEDS + 1)[1:]
        breakaway = self.coefficients(rig)[0]
        total = values[breakaway.parameter] * self._level(rig, v, shape) * self.over_speed(v, shape)
        for used in terms:
            other = used.term
            if not isinstance(other, Friction) or other == self or other.where != self.where:
                continue
            levels = [c for c in other.coefficients(rig) if c.unit == breakaway.unit]
            level = sum(values.get(c.parameter, 0.0) for c in levels) / max(len(levels), 1)
            total = total + level * other.over_speed(v, used.shape)
        fall = float(total.max() - total[-1])
        if fall >= SMALLEST_FALL * values[breakaway.parameter]:
            return ""
        return (
            f"up to {top:.3g} {unit}, the top speed of the records, dry friction falls by "
            f"{fall:.3g} {breakaway.unit}: that is no breakaway of {breakaway.parameter} = "
            f"{values[breakaway.parameter]:.3g}"
        )


TERMS = (CoulombFriction, StribeckFriction)
