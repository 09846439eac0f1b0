"""The smallest size of each effect that a person would want to know of.

On poor excitation an effect of this size may leave nothing in the residual; then `clean` says
little about it. Sizes are of a bench of some kW at some MPa, coefficients by the stem of their
names, shapes in their order; SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace.next_experiment.discrimination import Explanation
from rig.model import channels as ch
from rig.model.rig import Rig

COEFFICIENTS: Final[Mapping[str, tuple[float, ...]]] = {
    "asymmetric_friction": (30.0, 10.0),  # N either way
    "coulomb_friction": (15.0,),  # N
    "entrained_air": (3e-3,),  # of the volume, at one atmosphere
    "external_leakage": (3e-13,),  # m^3/(s Pa)
    "internal_leakage": (3e-13,),
    "joint_spring": (20.0,),  # N m/rad
    "pressure_dependent_friction": (5e-6,),  # m^2
    "stribeck_friction": (30.0,),  # N
    "torque_offset": (2.0,),  # N m
}
SHAPES: Final[Mapping[str, tuple[float, ...]]] = {
    "base_inclination": (0.017,),  # rad
    "channel_delay": (1e-3,),  # s
    "dead_volume": (20e-6,),  # m^3
    "spool_lag": (1e-3,),  # s
    "spool_offset": (1e-3,),  # V
    "supply_sag": (0.2e6, 0.0, 0.0),  # Pa at the rated flow
    "tank_pressure": (0.1e6, 0.0),  # Pa
    "underlap_leakage": (4e-3,),  # V
    "valve_deadband": (2e-3, 2e-3),  # V
}
GAIN: Final = 1.01  # of a sensor
OFFSETS: Final = {ch.CAP: 0.03e6, ch.ROD: 0.03e6, ch.SUPPLY: 0.03e6, ch.PISTON: 0.3e-3}


def smallest(effect: Effect, rig: Rig) -> Explanation | None:
    """Return an effect at its smallest interesting size, None where it has none or cannot show."""
    if effect.absorbed(rig):
        return None
    usual, own = effect.shape_of(rig, ()), SHAPES.get(effect.name, ())
    shape = (*own, *usual[len(own) :])
    if effect.name == "sensor_gain":
        shape = (GAIN,)
    elif effect.name == "sensor_offset":
        kind = _sensor(effect)
        if kind not in OFFSETS:
            return None
        shape = (OFFSETS[kind],)
    names = [c.parameter for c in effect.coefficients(rig)]
    sizes = COEFFICIENTS.get(effect.name, ())
    known = effect.name in COEFFICIENTS or effect.name in SHAPES
    if not known and effect.name not in ("sensor_gain", "sensor_offset"):
        return None
    return Explanation((Used(effect, shape),), dict(zip(names, sizes, strict=False)))


def _sensor(effect: Effect) -> str:
    sides = {"cap": ch.CAP, "rod": ch.ROD, "piston": ch.PISTON, "spool": ch.SPOOL}
    return sides.get(effect.side, ch.SUPPLY if effect.where == "bench" else "")
