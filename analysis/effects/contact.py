"""The contact of a seal: a state z, -1 <= z <= 1, that follows the direction of motion.

After each reversal z changes to the new direction within the presliding distance d (Dahl 1968;
Armstrong-Helouvry, Dupont and Canudas de Wit 1994; Jelali and Kroll 2003), and rubber is the
stiffer the faster it is deformed (Ferry 1980), here in proportion, with the stiffening k:

    dz/ds = (1 + k |s'|) (sign(s') - z) / d

Over the path s_w, ds_w = (1 + k |s'|) ds (`stiffened_path`), it is a contact without stiffening.

Where the reversal is finished within less travel than the records resolve, z is a function of the
velocity alone (`memoryless`), over a transition speed w: the mean sign of a velocity about s' that
is spread normally with the standard deviation w / sqrt 2,

    z = erf(s' / w).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numba import njit
from scipy.special import erf

from analysis.effects.base import Array, Shape
from rig.model import channels as ch
from rig.model.rig import Rig

SHEAR: Final = 0.02  # of the bore: a third of a seal's section, which is a fifteenth of the bore
GRID_RATIO: Final = 4.0  # between presliding distances where a search begins
YIELD: Final = 5e-3  # of the stroke: the largest presliding distance; a longer one is a spring
STIFFENING: Final = 30.0  # [s/m] where a search begins
STIFFENING_BOUNDS: Final = (1.0, 3e3)  # [s/m] a smaller one is below a tenth at 0.1 m/s: negligible
FASTEST: Final = 3e3  # [1/s] largest relaxation in simulation; a faster one looks the same
# Speed of the transition through rest [m/s, or rad/s] where no shape is given. A jump
# would make the integrator chatter where a joint sticks; this creeps by less than 0.1 mm/s there.
# On the measured positioning system 0.01 mm/s and 0.1 mm/s give the same parameters to 0.4 %,
# 1 mm/s does not (2 %).
TRANSITION: Final = 1e-4
# The spread of the velocity in a contact without memory.
NORMAL, CAUCHY = 0.0, 1.0
TWO_OVER_PI: Final = 2.0 / math.pi


@dataclass(frozen=True)
class ContactRange:
    """Search range of a contact's shapes: presliding distance [unit], transition speed [unit/s].

    A search begins at each of `distances` and at `speed`. A transition wider than its upper bound
    is viscous friction.
    """

    unit: str
    distances: tuple[float, ...]
    distance_bounds: tuple[float, float]
    speed: float
    speed_bounds: tuple[float, float]


# Seals give a few hundredths of a millimetre; belts, cables and gears a few milliradians.
LINEAR: Final = ContactRange("m", (5e-6, 40e-6, 150e-6), (2e-6, 5e-4), 1e-3, (TRANSITION, 2e-2))
ROTARY: Final = ContactRange("rad", (5e-5, 5e-4, 3e-3), (2e-6, 2e-2), 1e-2, (TRANSITION, 0.2))


def contact_range(rig: Rig, joint: int) -> ContactRange:
    """Return the range of a joint's contact (0-based): that of an angle on a revolute drive.

    A seal's section grows with the cylinder's bore, and with it its shear travel; what the
    cylinder's mounting yields under friction grows with the stroke.
    """
    if path_unit(rig, joint) == ROTARY.unit:
        return ROTARY
    if rig.electric:
        return LINEAR
    low, high = LINEAR.distance_bounds
    cylinder = rig.joints[joint].cylinder
    bore = 2.0 * math.sqrt(cylinder.cap_area / math.pi)
    high = max(high, SHEAR * bore, YIELD * cylinder.stroke)
    distances = list(LINEAR.distances)
    while distances[-1] * GRID_RATIO < high:  # from far below, a search ends at a local minimum
        distances.append(distances[-1] * GRID_RATIO)
    return replace(LINEAR, distances=tuple(distances), distance_bounds=(low, high))


def path_unit(rig: Rig, joint: int) -> str:
    """Return the unit of a joint's path of friction: m, or rad of a revolute drive."""
    return rig.unit_of(ch.channel(rig.position_kind, joint + 1))


def presliding(name: str, limits: ContactRange) -> Shape:
    """Return the presliding distance's shape; it may be below the sensors' resolution."""
    return Shape(name, limits.unit, *limits.distance_bounds, limits.distances, resolution=True)


def stiffening(name: str) -> Shape:
    """Return the stiffening's shape [s/m]; it may be too small to be visible."""
    return Shape(name, "s/m", *STIFFENING_BOUNDS, (STIFFENING,), resolution=True, detail=True)


def transition(name: str, limits: ContactRange) -> Shape:
    """Return the transition speed's shape of a contact without memory."""
    unit, speeds = f"{limits.unit}/s", limits.speed_bounds
    return Shape(name, unit, *speeds, (limits.speed,), resolution=True, detail=True)


def tail(name: str) -> Shape:
    """Return the shape that makes the spread of a contact Cauchy's instead of normal."""
    return Shape(name, "1", CAUCHY, CAUCHY, (CAUCHY,), detail=True, fixed=True)


def memoryless(v: Array, speed: float, tail: float = NORMAL) -> Array:
    """Return z (n,) of a velocity v (n,) [m/s], the transition speed w [m/s] and a tail."""
    if tail == CAUCHY:
        return np.asarray(TWO_OVER_PI * np.arctan(v / speed))
    return np.asarray(erf(v / speed))


def stiffened_path(s: Array, v: Array, stiffening: float) -> Array:
    """Return the path s_w (n,) [m] of a contact with stiffening: ds_w = (1 + k |s'|) ds.

    `s` (n,) [m] is the piston's path, `v` (n,) [m/s] its speed, `stiffening` k [s/m].
    """
    if stiffening == 0.0:
        return np.ascontiguousarray(s)
    speed = np.abs(v)
    out = np.empty(len(s))
    out[0] = s[0]
    out[1:] = s[0] + np.cumsum(np.diff(s) * (1.0 + 0.5 * stiffening * (speed[1:] + speed[:-1])))
    return out


@njit(cache=True, error_model="numpy")
def contact_state(s, distance):  # type: ignore[no-untyped-def]
    """Return z (n,) of the path s (n,) [m]: exact over every step, which is taken as monotone."""
    z = np.zeros(len(s))
    for k in range(1, len(s)):
        step = s[k] - s[k - 1]
        side = 1.0 if step > 0.0 else -1.0
        z[k] = side + (z[k - 1] - side) * math.exp(-abs(step) / distance)
    return z


@njit(cache=True, error_model="numpy")
def contact_under_load(s, levels, stiffness):  # type: ignore[no-untyped-def]
    """Return the force w (n,) of a contact along the path s (n,) [m], exact over every step.

    Its level (n,) changes, its stiffness [unit of level / m] does not:
    dw/ds = stiffness (sign(s') - w / level) (Dahl 1968).
    """
    w = np.zeros(len(s))
    for k in range(1, len(s)):
        step = s[k] - s[k - 1]
        level = levels[k] if step > 0.0 else -levels[k]
        decay = math.exp(-abs(step) * stiffness / levels[k]) if levels[k] > 0.0 else 0.0
        w[k] = level + (w[k - 1] - level) * decay
    return w


@njit(cache=True, error_model="numpy")
def contact_levels(s, extending, retracting):  # type: ignore[no-untyped-def]
    """Return the shares a, r (n,) of the two levels along the path s (n,) [m], exact per step."""
    a, r = np.zeros(len(s)), np.zeros(len(s))
    for k in range(1, len(s)):
        step = s[k] - s[k - 1]
        if step > 0.0:
            decay = math.exp(-step / extending)
            a[k], r[k] = 1.0 + (a[k - 1] - 1.0) * decay, r[k - 1] * decay
        else:
            decay = math.exp(step / retracting)
            a[k], r[k] = a[k - 1] * decay, 1.0 + (r[k - 1] - 1.0) * decay
    return a, r


@njit(cache=True, error_model="numpy")
def mean_sign(v, speed, tail):  # type: ignore[no-untyped-def]
    """Return `memoryless` of one velocity v [m/s]."""
    if tail == CAUCHY:
        return TWO_OVER_PI * math.atan(v / speed)
    return math.erf(v / speed)


@njit(cache=True, error_model="numpy")
def slide(v, y, distance, stiffening, speed, tail):  # type: ignore[no-untyped-def]
    """Return (z, dy/dt) of the deflection y = d z, its relaxation bounded at `FASTEST`.

    With a distance of 0 the contact is memoryless, of the transition speed and tail.
    """
    if distance <= 0.0:
        return mean_sign(v, speed, tail), 0.0
    pace = 1.0 + stiffening * abs(v)
    relax = abs(v) / distance
    return y / distance, pace * (v - relax * y) / (1.0 + pace * relax / FASTEST)
