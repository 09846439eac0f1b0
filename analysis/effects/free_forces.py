"""Forces at the piston as free curves: over speed by direction, over position.

Named effects are special cases of these curves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Branch, Effect, Evidence, Shape
from analysis.effects.contact import NORMAL, contact_range, path_unit, slide
from analysis.effects.curve import (
    LAST,
    curve_at,
    knot_shapes,
    knot_values,
    outer_knots,
    packed,
    refuse_large,
    shortest_wave,
    shown,
    spline,
    spread_knots,
)
from analysis.effects.friction import Friction, force_limit, force_unit
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    SD,
    TORQUE,
    Coefficient,
    Columns,
    G,
    S,
    equation,
    kernel,
)
from rig.model.rig import Rig

SPEEDS: Final = 4  # knots of |s'|, the first at rest
PLACES: Final = 9  # knots of s: a tight place is local
GROWS: Final = (-0.8, -0.3, 0.3, 0.8)  # starting growths up to the end, over friction at mid-stroke
MOST_GROWTH: Final = 2.0  # in the same unit: friction vanishes half way to an end
ALIKE: Final = 0.03  # share of gravity that no curve of s fits: below, the records have one pose
DRIVES: Final = 0.1  # of the curve's largest force: negative friction within its uncertainty
# Values at the knots of f per coefficient where G is 1: there a slope from the first to the last
# knot is the baseline's viscous friction, and is left out. Elsewhere viscous friction goes with
# G^2, and each knot has its own coefficient.
LEVEL: Final = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=np.float64)


def _refuse_large_force(rig: Rig, joint: int, y: Array, what: str) -> str:
    """Return the message for a curve y (m,) [N] above half of the joint's force ('' if not)."""
    return refuse_large(y, force_limit(rig, joint), what, force_unit(rig, joint))


@kernel
def _over_speed(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        v = x[SD, i]
        state, dz[0] = slide(v, z[0], par[1], 0.0, par[2], NORMAL)
        force = state * curve_at(abs(v), par, 3, 4) + abs(state) * curve_at(abs(v), par, 15, 4)
        out[TORQUE, i] -= x[G, i] * force * max(0.0, 1.0 + par[27] * (x[S, i] - par[28]))


@dataclass(frozen=True)
class FrictionCurve(Friction):
    """F_f = max(0, 1 + k x) (z f(|s'|) + |z| g(|s'|)): friction over speed by direction.

    z is the contact's state (`contact`), f and g are curves (`curve`): f is shared by both
    directions, g is the extra friction of extending. On an electric joint the slope of f over the
    records' speeds is Fv. The growth k over the distance x from mid-stroke is a detail of the form:
    a bore or a seal that is tighter towards one end, and free where 1 + k x is below 0.
    """

    name = "friction_curve"
    mechanism = "friction_curve"
    element = "piston"
    free = True
    by_data = True
    variable = "the piston's velocity"
    confounders = ("position_force",)
    separated_by = "slow and fast motion about several places of the stroke"
    shapes_before = SPEEDS
    shapes_after = 1
    kernel = _over_speed

    def knot_names(self) -> tuple[str, ...]:
        """Name the knots."""
        return tuple(f"friction_{self.joint + 1}_knot_{k}" for k in range(1, SPEEDS + 1))

    def shape_names(self) -> tuple[str, ...]:
        """Name knots, presliding distance, transition speed and growth."""
        return (*self.knot_names(), *super().shape_names(), f"growth_{self.joint + 1}")

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return knots [m/s], presliding distance [m], transition speed [m/s] and growth [1/m]."""
        speed = rig.joints[self.joint].limits.speed
        most = 1.0 / self._half(rig)  # the friction vanishes at one end of the stroke
        bound, grid = MOST_GROWTH * most, tuple(share * most for share in GROWS)
        unit = path_unit(rig, self.joint)
        growth = Shape(self.shape_names()[-1], f"1/{unit}", -bound, bound, grid, detail=True)
        knots = knot_shapes(self.knot_names(), f"{unit}/s", 0.0, speed)
        return (*knots, *super().shapes(rig), growth)

    def _half(self, rig: Rig) -> float:
        """Return half of the stroke [m]."""
        low, high = rig.joints[self.joint].position_range
        return 0.5 * (high - low)

    def _middle(self, rig: Rig) -> float:
        """Return the middle of the stroke [m]."""
        return 0.5 * float(sum(rig.joints[self.joint].position_range))

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shapes with growths along the stroke from which a search begins.

        Viscous friction with the curve's slope, whose levers differ, imitates a growth: a search
        from a small growth may end there.
        """
        growth_index = self._speed_index() + 1
        if len(shape) > growth_index:
            return (tuple(shape),)
        padded = (*shape, *(0.0,) * (growth_index - len(shape)))
        return tuple((*padded, growth) for growth in self.shapes(rig)[-1].grid)

    def _growth(self, shape: Sequence[float]) -> float:
        """Return the growth [1/m] of a shape, 0 where it has none."""
        return shape[-1] if len(shape) == len(self.shape_names()) else 0.0

    def _along(self, rig: Rig, shape: Sequence[float], s: Array) -> Array:
        """Return the friction at positions s [m] over that at mid-stroke."""
        return np.maximum(0.0, 1.0 + self._growth(shape) * (s - self._middle(rig)))

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the range of the friction along the stroke, over that at mid-stroke."""
        growth, i = self._growth(shape), self.joint
        places = [f(x.s[:, i]) for x in signals if x.excited[i] for f in (np.min, np.max)]
        if growth == 0.0 or not places:
            return ""
        ends = sorted(self._along(rig, shape, np.array([min(places), max(places)])).tolist())
        return (
            f"along the stroke of the records the friction is {ends[0]:.2f} to {ends[1]:.2f} times "
            "that at mid-stroke, which the curve shows"
        )

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots at quantiles of the joint's speed, each with some presliding distances."""
        speed = evidence.of_joint(self.joint, lambda x: np.abs(x.sd[:, self.joint]))
        knots = spread_knots(speed, (0.0, 0.35, 0.75, LAST), low=0.0)
        distances = contact_range(rig, self.joint).distances
        return tuple((*map(float, knots), d) for d in distances) if len(knots) else ()

    @staticmethod
    def _shared(rig: Rig) -> Array:
        return LEVEL if rig.electric else np.eye(SPEEDS)

    def _names(self, rig: Rig) -> tuple[tuple[str, ...], tuple[str, ...]]:
        joint = self.joint + 1
        count = self._shared(rig).shape[1]
        shared = tuple(f"friction_{joint}_shared_{k}" for k in range(1, count + 1))
        return shared, tuple(f"friction_{joint}_extending_{k}" for k in range(1, SPEEDS + 1))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the values at the knots [N]: of f (electric: without its slope), then of g."""
        unit = force_unit(rig, self.joint)
        return tuple(Coefficient(n, unit, "mechanical") for part in self._names(rig) for n in part)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G z and G |z| times the curves' bases."""
        i, shape = self.joint, self.shape_of(rig, shape)
        along, z = self._along(rig, shape, signals.s[:, i]), self.contact(rig, signals, shape)
        basis = spline(shape[:SPEEDS], np.abs(signals.sd[:, i]))
        shared, extending = self._names(rig)
        odd = (signals.G[:, i] * along * z)[:, None] * (basis @ self._shared(rig))
        even = (signals.G[:, i] * along * self.size(signals, z, shape))[:, None] * basis
        return self.row(dict(zip((*shared, *extending), (*odd.T, *even.T), strict=True)))

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, distance, transition speed, both curves, growth, middle of the stroke."""
        shape = self.shape_of(rig, shape)
        shared, extending = self._names(rig)
        f = self._shared(rig) @ np.array([values[name] for name in shared])
        g = np.array([values[name] for name in extending])
        distance, _, speed = self.contact_of(shape)
        knots = shape[:SPEEDS]
        along = self._growth(shape), self._middle(rig)
        return np.array([self.joint, distance, speed, *packed(knots, f), *packed(knots, g), *along])

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return friction [N] over speed [m/s], the joint's Fv at mid-stroke included."""
        knots, (shared, extending) = shape[:SPEEDS], self._names(rig)
        v = np.concatenate((-shown(knots)[::-1], shown(knots)))
        basis, side = spline(knots, np.abs(v)), np.repeat([-1.0, 1.0], len(v) // 2)
        lever = float(rig.joints[self.joint].geometry(0.0)[1])
        weights = dict(zip(shared, (side[:, None] * (basis @ self._shared(rig))).T, strict=True))
        weights |= dict(zip(extending, basis.T, strict=True))
        weights[f"Fv{self.joint + 1}"] = v / lever**2
        unit = force_unit(rig, self.joint)
        return (Branch("friction over speed", v, weights, f"{path_unit(rig, self.joint)}/s", unit),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject negative friction, and more than half of the cylinder's force."""
        (line,) = self.branches(rig, self.shape_of(rig, shape))
        parts = {name: w * values.get(name, 0.0) for name, w in line.weights.items()}
        whole = np.asarray(sum(parts.values()))
        curve = np.asarray(sum(y for name, y in parts.items() if name != f"Fv{self.joint + 1}"))
        against = whole * np.sign(line.x)
        if np.min(against[line.x != 0.0]) < -DRIVES * np.max(np.abs(curve)):
            return "friction would drive the piston"
        return _refuse_large_force(rig, self.joint, against, "friction")


@kernel
def _over_position(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        out[TORQUE, i] -= x[G, i] * curve_at(x[S, i], par, 1, PLACES)


@dataclass(frozen=True)
class PositionForce(Effect):
    """F = f(s) against extension: a force over the piston's position, f a curve (`curve`).

    One value at a knot follows from the others, by weights (the gauge) that are fixed with the
    knots. Where the joints below have one pose in all records, gravity is a force over position
    too, and the curve is the remainder; elsewhere the highest divided difference is zero.
    """

    name = "position_force"
    family = "mechanics"
    mechanism = "position_force"
    free = True
    by_data = True
    variable = "the piston's position"
    quantity = "position"
    confounders = ("friction_curve",)
    separated_by = "slow motion over the whole stroke at two poses of other joints"
    kernel = _over_position
    where: str = "joint 1"

    def shape_names(self) -> tuple[str, ...]:
        """Name the knots, then the gauge's weights."""
        joint, numbers = self.joint + 1, range(1, PLACES + 1)
        knots = tuple(f"position_{joint}_knot_{k}" for k in numbers)
        return (*knots, *(f"position_{joint}_gauge_{k}" for k in numbers))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return knots [m] and gauge [-]."""
        low, high = rig.joints[self.joint].position_range
        names = self.shape_names()
        even = np.linspace(low, high, PLACES)
        gauge = zip(names[PLACES:], shortest_wave(even), strict=True)
        fixed = tuple(Shape(name, "", -1.0, 1.0, (float(v),), fixed=True) for name, v in gauge)
        return (*knot_shapes(names[:PLACES], path_unit(rig, self.joint), low, high), *fixed)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return knots evenly over the piston's travel, and the gauge of these records."""
        place = evidence.of_joint(self.joint, lambda x: x.s[:, self.joint])
        knots = spread_knots(outer_knots(place), np.linspace(0.0, 1.0, PLACES).tolist())
        if not len(knots):
            return ()
        gauge = self._gravity_gauge(rig, evidence, knots)
        gauge = shortest_wave(knots) if gauge is None else gauge
        return ((*map(float, knots), *map(float, gauge)),)

    def _gravity_gauge(self, rig: Rig, evidence: Evidence, knots: Array) -> Array | None:
        """Return the gauge (K,) that assigns the joint's weight to gravity.

        None where the records determine the weight without it (a joint below moves, or stands in
        several poses), or there is no weight.
        """
        i = self.joint
        below = any(s.moving[:i].any() for s in evidence.signals)
        if below or rig.gravity == 0 or getattr(rig, "prismatic", False):
            return None
        s = evidence.of_joint(i, lambda x: x.s[:, i])
        lever = evidence.of_joint(i, lambda x: x.G[:, i])
        basis = lever[:, None] * spline(tuple(knots), s)
        pull = evidence.of_joint(i, lambda x: np.sin(x.theta[:, i]))
        fit = np.linalg.lstsq(basis, pull, rcond=1e-9)[0]
        if np.linalg.norm(pull - basis @ fit) > ALIKE * np.linalg.norm(pull - np.mean(pull)):
            return None
        gauge = basis.T @ pull
        return np.asarray(gauge / np.linalg.norm(gauge))

    def _names(self) -> tuple[str, ...]:
        return tuple(f"F_position_{self.joint + 1}_{k}" for k in range(1, PLACES))

    def _basis(self, shape: Sequence[float], x: Array) -> Array:
        """Return the curve (n, K - 1) per unit of every coefficient."""
        return np.asarray(spline(shape[:PLACES], x) @ knot_values(np.array(shape[PLACES:])))

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the values at the knots [N] but the one that the gauge gives."""
        unit = force_unit(rig, self.joint)
        return tuple(Coefficient(name, unit, "mechanical") for name in self._names())

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G times the curve's basis."""
        i = self.joint
        basis = self._basis(self.shape_of(rig, shape), signals.s[:, i])
        columns = (signals.G[:, i, None] * basis).T
        return {equation("torque", i): dict(zip(self._names(), columns, strict=True))}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, curve."""
        shape = self.shape_of(rig, shape)
        free = np.array([values[name] for name in self._names()])
        y = knot_values(np.array(shape[PLACES:])) @ free
        return np.array([self.joint, *packed(shape[:PLACES], y)])

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the force [N] over the position [m]."""
        at = shown(shape[:PLACES])
        weights = dict(zip(self._names(), self._basis(shape, at).T, strict=True))
        unit = force_unit(rig, self.joint)
        return (Branch("force over position", at, weights, path_unit(rig, self.joint), unit),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject more than half of the cylinder's force."""
        y = np.array([values[name] for name in self._names()])
        return _refuse_large_force(rig, self.joint, y, "the force")


TERMS = (FrictionCurve, PositionForce)
