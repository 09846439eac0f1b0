"""Viscous friction whose slope depends on the direction of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Effect
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    SD,
    TORQUE,
    Coefficient,
    Columns,
    G,
    equation,
    kernel,
)
from rig.model.rig import Rig

DRIVING: Final = 0.1  # of the larger slope: a negative one within its uncertainty
# Of the mean slope: slopes with a smaller difference count as equal. Dry friction beside them has a
# form error of its own in each direction.
DIFFERENCE: Final = 0.01
BESIDE_DRY: Final = 0.1
DRY: Final = ("Fc", "Fs", "F_ext_", "F_ret_", "k_friction_")  # its parameters without the joint


@kernel
def _by_direction(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        i = int(par[0])
        v = x[SD, i]
        out[TORQUE, i] -= x[G, i] * v * (par[1] if v > 0.0 else par[2])


@dataclass(frozen=True)
class AsymmetricViscousFriction(Effect):
    """F = c_ext s' extending, c_ret s' retracting, beside the joint's Fv q': slopes by direction.

    Wipers and lip seals carry less oil in one direction (Jelali and Kroll 2003). The slope of a
    direction is its coefficient plus Fv G^-2; the records determine the difference well. On an
    electric joint G is 1, Fv is the mean slope, and the one coefficient dFv, of the column |q'|, is
    half the difference.
    """

    mechanism = "friction_curve"
    element = "piston"
    name = "asymmetric_viscous_friction"
    smallest_coefficients = (50.0, 0.0)  # [N s/m]
    family = "friction"
    variable = "the amount of the piston's velocity"
    quantity = "velocity"
    confounders = ("torque_offset", "asymmetric_friction", "coulomb_friction")
    separated_by = (
        "two speeds of one motion: offset and difference of levels stay the same, this doubles"
    )
    kernel = _by_direction
    where: str = "joint 1"

    def _names(self, rig: Rig) -> tuple[str, ...]:
        if rig.electric:
            return (f"dFv{self.joint + 1}",)
        return f"c_ext_{self.joint + 1}", f"c_ret_{self.joint + 1}"

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return c_ext, c_ret [N s/m] (electric: dFv, half the difference of slopes)."""
        unit = rig.unit_of_parameter(f"Fv{self.joint + 1}") if rig.electric else "N*s/m"
        return tuple(Coefficient(name, unit, "mechanical") for name in self._names(rig))

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return G times the part of s' that goes either way (electric: |q'|)."""
        i = self.joint
        G, v = signals.G[:, i], signals.sd[:, i]
        way = signals.direction(i)
        parts = (v * way,) if rig.electric else (v * (way > 0.0), v * (way <= 0.0))
        columns = {name: G * part for name, part in zip(self._names(rig), parts, strict=True)}
        return {equation("torque", i): columns}

    def slopes(self, rig: Rig, values: Mapping[str, float]) -> tuple[float, float]:
        """Return the whole slopes extending and retracting at mid-stroke [N s/m]."""
        lever = float(rig.joints[self.joint].geometry(0.0)[1])
        mean = values.get(f"Fv{self.joint + 1}", np.nan) / lever**2
        linear = [values[name] for name in self._names(rig)]
        extending, retracting = linear if len(linear) == 2 else (linear[0], -linear[0])
        return mean + extending, mean + retracting

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, slopes extending and retracting."""
        linear = [values[name] for name in self._names(rig)]
        return np.array([self.joint, linear[0], linear[1] if len(linear) == 2 else -linear[0]])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a slope that drives the joint, and slopes that count as equal."""
        slopes = self.slopes(rig, values)
        for way, slope in zip(("extending", "retracting"), slopes, strict=True):
            if slope < -DRIVING * max(slopes):
                return f"a slope of {slope:.3g} N s/m {way} would drive the joint"
        beside_dry = any(f"{name}{self.joint + 1}" in values for name in DRY)
        least = BESIDE_DRY if beside_dry else DIFFERENCE
        # c_ext = c_ret is no asymmetry either: beside Fv q' it depends on the lever arm, as does a
        # friction that changes along the stroke.
        sizes = [abs(values[name]) for name in self._names(rig)]
        if abs(slopes[0] - slopes[1]) < least * max(0.5 * sum(slopes), min(sizes)):
            return f"the slopes of the two directions differ by less than {100 * least:.0f} %"
        return ""


TERMS = (AsymmetricViscousFriction,)
