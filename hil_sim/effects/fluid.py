"""Effects on the oil: leakage, supply and return, free air, volume."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from hil_sim.effects.base import BenchEffect, JointEffect, Tables, in_unit, set_relief
from rig.model.quantity import Flow, Length, Pressure, Ratio, Time, Volume

Conductance = Annotated[float, in_unit("m^3/(s*Pa)")]

ACCUMULATOR = 5e-3  # volume of oil as soft as the accumulator [m^3]


class InternalLeakage(JointEffect):
    """Leakage past the piston, cap to rod; in a bore worn around its middle, only there."""

    sizes: ClassVar = {"conductance": (5e-13, 3e-12)}

    name: Literal["internal_leakage"]
    conductance: Conductance = Field(gt=0)
    worn: Length | None = Field(default=None, gt=0, description="half length of the wear [m]")

    def apply(self, t: Tables) -> None:
        t.joints["leak_internal"][self.joint] += self.conductance
        t.joints["leak_length"][self.joint] = self.worn or math.inf


class ExternalLeakage(JointEffect):
    """Leakage from one chamber, or both, to tank."""

    drawn_at = "chamber"
    sizes: ClassVar = {"conductance": (5e-13, 3e-12)}

    places = ("joint", "chamber")
    name: Literal["external_leakage"]
    conductance: Conductance = Field(gt=0)

    def apply(self, t: Tables) -> None:
        for chamber in (self.chamber,) if self.chamber else ("cap", "rod"):
            t.joints[f"leak_{chamber}"][self.joint] += self.conductance


class SupplySag(BenchEffect):
    """A weak supply: less pump flow, a larger override of the relief valve, a line drop."""

    sizes: ClassVar = {"line_drop": (0.3e6, 1e6)}

    name: Literal["supply_sag"]
    flow: Flow | None = Field(default=None, gt=0, description="flow that the pump delivers")
    override: Pressure | None = Field(default=None, gt=0, description="relief, cracking to full")
    line_drop: Pressure | None = Field(
        default=None, gt=0, description="between pump and valves at the rig's pump flow"
    )
    manifold_volume: Volume = Field(default=0.2e-3, gt=0)
    form: Literal["turbulent", "laminar", "accumulator"] = "turbulent"

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.flow is None and self.override is None and self.line_drop is None:
            raise ValueError("give at least one of flow, override, line_drop")
        return self

    def apply(self, t: Tables) -> None:
        rated = t.rig.supply.flow
        if self.flow is not None:
            t.bench["pump"] = self.flow
        if self.override is not None:
            set_relief(t, self.override)
        if self.line_drop is not None:
            t.bench["line_gain"] = rated / math.sqrt(self.line_drop)
            t.bench["manifold_volume"] = self.manifold_volume
            if self.form == "laminar":
                t.bench["line_laminar"] = rated / self.line_drop
            elif self.form == "accumulator":
                # Compliance of its gas: the manifold's pressure follows the line's within about 50
                # ms.
                t.bench["manifold_volume"] = ACCUMULATOR


class TankPressure(BenchEffect):
    """Return pressure: a constant part and one proportional to the square of the returned flow."""

    sizes: ClassVar = {"pressure": (0.1e6, 0.4e6)}

    name: Literal["tank_pressure"]
    pressure: Pressure = Field(ge=0)
    back_pressure: Pressure = Field(default=0.0, ge=0, description="more at the rig's pump flow")
    lag: Time = Field(default=5e-3, ge=5e-4)

    def apply(self, t: Tables) -> None:
        t.bench["tank_pressure"] = self.pressure
        t.bench["tank_resistance"] = self.back_pressure / t.rig.supply.flow**2
        t.bench["tank_lag"] = self.lag


class EntrainedAir(BenchEffect):
    """Free air, a share by volume at atmospheric pressure; it dissolves over `dissolution`."""

    sizes: ClassVar = {"fraction": (3e-3, 3e-2)}

    name: Literal["entrained_air"]
    fraction: Ratio = Field(gt=0, lt=0.2)
    dissolution: Pressure = Field(default=10e6, gt=0)
    form: Literal["isothermal", "polytropic", "undissolved"] = "isothermal"

    def apply(self, t: Tables) -> None:
        t.bench["air"] = self.fraction
        t.bench["air_dissolution"] = 1e12 if self.form == "undissolved" else self.dissolution
        t.bench["air_exponent"] = 1.4 if self.form == "polytropic" else 1.0


class DeadVolume(JointEffect):
    """Oil between valve and chamber in addition to the rig file's volume."""

    drawn_at = "chamber"
    sizes: ClassVar = {"volume": (20e-6, 100e-6)}

    places = ("chamber",)
    name: Literal["dead_volume"]
    volume: Volume = Field(gt=0)

    def apply(self, t: Tables) -> None:
        t.joints[f"{self.chamber}_volume"][self.joint] += self.volume


class ReturnLine(BenchEffect):
    """A return line with a drop: none at rest, `drop` at the rig's pump flow.

    ``turbulent`` with the flow's square, ``laminar`` in proportion, ``filter`` half of each.
    """

    sizes: ClassVar = {"drop": (0.4e6, 1.5e6)}

    name: Literal["return_line"]
    drop: Pressure = Field(gt=0)
    lag: Time = Field(default=1e-3, ge=5e-4)
    form: Literal["turbulent", "laminar", "filter"] = "turbulent"

    def apply(self, t: Tables) -> None:
        square = {"turbulent": 1.0, "laminar": 0.0, "filter": 0.5}[self.form]
        rated = t.rig.supply.flow
        t.bench["tank_resistance"] += square * self.drop / rated**2
        t.bench["tank_laminar"] += (1.0 - square) * self.drop / rated
        t.bench["tank_lag"] = self.lag
