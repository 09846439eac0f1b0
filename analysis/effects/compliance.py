"""Effects on the oil's stiffness: free air, and volume that the rig file does not state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from analysis.effects.base import VOLUME, Array, Effect, Shape, SignalEffect, exponent, out_of_range
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    P_CAP,
    P_ROD,
    PREPARE,
    V_CAP,
    V_ROD,
    Coefficient,
    Columns,
    equation,
    kernel,
)
from rig.model.rig import Rig
from rig.model.units import plain

ATMOSPHERE: Final = 101_325.0  # [Pa]
DEEPEST: Final = 0.95 * ATMOSPHERE  # [Pa] below gauge zero: a deeper vacuum is a sensor's error
MOST_AIR: Final = 0.2  # of the volume, at one atmosphere
EXPONENTS: Final = (1.0, 1.4)  # polytropic: isothermal, adiabatic
MOST_VOLUME: Final = 10.0  # of the oil in pipe and chamber at mid-stroke
# A hose's stiffening times the supply's pressure, first tried and largest: at that pressure its
# volume V_dead is a fourth, or an eleventh, of that at zero.
HOSE, STIFFEST = 3.0, 10.0


@kernel
def _air(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        n = par[1]
        for i in range(x.shape[1]):
            cap = max(x[P_CAP, i], -DEEPEST) + ATMOSPHERE
            rod = max(x[P_ROD, i], -DEEPEST) + ATMOSPHERE
            out[COMP_CAP, i] += par[0] * x[V_CAP, i] * (ATMOSPHERE / cap) ** (1 / n) / (n * cap)
            out[COMP_ROD, i] += par[0] * x[V_ROD, i] * (ATMOSPHERE / rod) ** (1 / n) / (n * rod)


@dataclass(frozen=True)
class EntrainedAir(Effect):
    """A share alpha of free air at atmospheric pressure p0 makes the oil softer at low pressure.

    1/b_eff = 1/b + alpha / (n (p + p0)) (p0 / (p + p0))^(1/n), p gauge (Merritt 1967, chapter 2).
    The polytropic exponent n, a shape, is 1 for isothermal and 1.4 for adiabatic bubbles (Wylie and
    Streeter 1993). Linear in alpha.
    """

    mechanism = "bulk_modulus_curve"
    element = "chamber"
    name = "entrained_air"
    smallest_coefficients = (3e-3,)  # of the volume, at one atmosphere
    hydraulic = True
    family = "fluid"
    variable = "the pressure rate at low chamber pressure"
    quantity = "pressure"
    confounders = ("dead_volume", "spool_lag", "channel_delay")
    separated_by = (
        "fast pressure changes at low and at high chamber pressure: dead volume acts alike at both"
    )
    shape_stems = ("air_exponent",)
    kernel = _air

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return alpha [-]."""
        return (Coefficient("alpha_air", "", "fluid"),)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return n [-], from isothermal to adiabatic."""
        low, high = EXPONENTS
        name = self.shape_names()[0]
        return (Shape(name, "", low, high, (1.2,), resolution=True, detail=True),)

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the form with a variable exponent."""
        return () if len(shape) else ((1.2,),)

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape unchanged: the exponent is not a detail but another form."""
        return (tuple(shape),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return - V dp/dt times the compressibility of each chamber's gas per alpha."""
        out: Columns = {}
        n = exponent(shape)
        for i in signals.excited_joints:
            for side, V, p, rate in (
                ("flow_cap", signals.V_cap, signals.p_cap, signals.pd_cap),
                ("flow_rod", signals.V_rod, signals.p_rod, signals.pd_rod),
            ):
                absolute = np.maximum(p[:, i], -DEEPEST) + ATMOSPHERE
                softness = (ATMOSPHERE / absolute) ** (1.0 / n) / (n * absolute)
                column = -V[:, i] * rate[:, i] * softness
                out[equation(side, i)] = {"alpha_air": column}
        return out

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative share, and one above `MOST_AIR`."""
        return out_of_range("alpha_air", values["alpha_air"], "", MOST_AIR)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return alpha and n."""
        return np.array([values["alpha_air"], exponent(shape)])


@kernel
def _dead(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        i = int(par[0])
        x[V_CAP, i] += par[1] / (1.0 + par[3] * max(x[P_CAP, i], 0.0))
        x[V_ROD, i] += par[2] / (1.0 + par[3] * max(x[P_ROD, i], 0.0))


@dataclass(frozen=True)
class DeadVolume(SignalEffect):
    """Oil between valve and chamber beyond the rig file's pipe volume: V = V_file + V_dead.

    It is negative where the file states more than there is, at most the whole pipe. A hose gives
    like more oil, the less the higher its pressure p: V_dead (1 + k p0) / (1 + k p), k its
    stiffening, p0 half of the supply's pressure (Merritt 1967, chapter 1: effective modulus).
    Enters as V_dead dp/dt / b (continuity; Merritt 1967, chapter 3), in proportion to the 1/b
    that all chambers share: a shape, so that b stays one. For one chamber the others separate it
    from a smaller b; the same volume in all chambers is separated only by the change of V with the
    piston.
    """

    mechanism = "chamber_volume"
    element = "chamber"
    name = "dead_volume"
    smallest_shape = (20e-6,)  # [m^3]
    prepares = True
    hydraulic = True
    family = "fluid"
    stage = VOLUME
    alters = ("fluid",)
    variable = "the chamber's pressure rate"
    quantity = "pressure rate"
    confounders = ("entrained_air", "spool_lag", "channel_delay")
    separated_by = "fast pressure changes near both ends of the stroke, of several chambers"
    shape_stems = ("V_dead", "stiffening")
    kernel = _dead
    where: str = "joint 1 cap"

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each chamber of each hydraulic joint."""
        return tuple(
            f"{joint} {side}" for joint in super().all_places(rig) for side in ("cap", "rod")
        )

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the volume [m^3], up to `MOST_VOLUME` times the oil in pipe and chamber.

        Its lower bound is minus the stated pipe's volume. The stiffening [1/Pa] is a detail.
        """
        cap, rod = map(float, rig.chamber_volumes(self.joint, np.zeros(())))
        oil = cap if self.side == "cap" else rod
        stated = self._stated(rig)
        grid = (-0.2 * stated, 0.05 * oil, 0.25 * oil, 1.0 * oil)
        (volume, stiffening), p = self.shape_names(), rig.supply.pressure
        return (
            Shape(volume, "m^3", -stated, MOST_VOLUME * oil, grid, 0.0),
            Shape(stiffening, "1/Pa", 0.0, STIFFEST / p, (1.0 / p,), resolution=True, detail=True),
        )

    def further_points(self, rig: Rig) -> tuple[tuple[float, ...], ...]:
        """Return hoses: a smaller b can replace a rigid volume, but not one that stiffens."""
        volume, _ = self.shapes(rig)
        return tuple((start, HOSE / rig.supply.pressure) for start in volume.grid[1:3])

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the rigid volume of a hose."""
        return (tuple(shape[:1]),) if len(shape) > 1 else ()

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Add the volume to that of the chamber."""
        field = "V_cap" if self.side == "cap" else "V_rod"
        V = getattr(signals, field).copy()
        p = (signals.p_cap if self.side == "cap" else signals.p_rod)[:, self.joint]
        slack, stiffening = self.slack(rig, shape)
        V[:, self.joint] += slack / (1.0 + stiffening * np.maximum(p, 0.0))
        return replace(signals, **{field: V})

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the pipe's volume where the rig file has too much."""
        stated = self._stated(rig)
        volume = self.shape_of(rig, shape)[0]
        if volume >= 0.0:
            return ""
        return (
            f"by these records the pipe holds {plain(1e6 * (stated + volume), 3)} cm³, not the "
            f"{plain(1e6 * stated, 3)} cm³ of the rig file (`{self.side}_pipe_volume`)"
        )

    def _stated(self, rig: Rig) -> float:
        """Return the volume of the chamber's pipe in the rig file [m^3]."""
        cylinder = rig.joints[self.joint].cylinder
        return float(cylinder.cap_pipe_volume if self.side == "cap" else cylinder.rod_pipe_volume)

    def slack(self, rig: Rig, shape: Sequence[float]) -> tuple[float, float]:
        """Return the volume [m^3] at no pressure and its stiffening [1/Pa]."""
        V, stiffening = self.full_shape(rig, shape)
        return V * (1.0 + stiffening * 0.5 * rig.supply.pressure), stiffening

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, volume at no pressure of the cap side, of the rod side, stiffening."""
        V, stiffening = self.slack(rig, shape)
        sides = V * (self.side == "cap"), V * (self.side == "rod")
        return np.array([self.joint, *sides, stiffening])


TERMS = (EntrainedAir, DeadVolume)
