"""Effects between the spool's LVDT and the metering edges."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from hil_sim.effects.base import BenchEffect, JointEffect, Tables
from rig.model.quantity import Pressure, Time, Voltage


class ValveDeadband(JointEffect):
    """Overlapped spool: dead band `width` for u > 0, `astern` (default: `width`) for u < 0 [V]."""

    sizes: ClassVar = {"width": (4e-3, 20e-3)}

    name: Literal["valve_deadband"]
    width: Voltage = Field(gt=0, description="of the spool's LVDT [V]")
    astern: Voltage | None = Field(default=None, gt=0)
    rounding: Voltage | None = Field(default=None, gt=0, description="default: a fifth of width")
    form: Literal["round", "sharp", "notch"] = "round"

    def apply(self, t: Tables) -> None:
        t.joints["lap_ahead"][self.joint] += self.width
        t.joints["lap_astern"][self.joint] += self.astern or self.width
        if self.form == "round":
            t.joints["rounding"][self.joint] += self.rounding or 0.2 * self.width
        elif self.form == "notch":
            t.joints["notch"][self.joint] = 2.0 * self.width


class UnderlapLeakage(JointEffect):
    """Underlapped spool: within `width` [V] of null all edges are open, also pump to tank."""

    sizes: ClassVar = {"width": (4e-3, 15e-3)}

    name: Literal["underlap_leakage"]
    width: Voltage = Field(gt=0)
    rounding: Voltage | None = Field(default=None, gt=0, description="default: half of width")
    form: Literal["round", "sharp", "notch"] = "round"

    def apply(self, t: Tables) -> None:
        t.joints["lap_ahead"][self.joint] -= self.width
        t.joints["lap_astern"][self.joint] -= self.width
        if self.form == "round":
            t.joints["rounding"][self.joint] += self.rounding or 0.5 * self.width
        elif self.form == "notch":
            t.joints["notch"][self.joint] = self.width


class LaminarOrifice(BenchEffect):
    """Metering edges that are laminar below a pressure drop of `transition`, at every valve.

    ``smooth``: the edges of the plant with a larger transition. ``cubic``: nothing is lost above
    it. ``tanh``: a flow coefficient that rises with the Reynolds number.
    """

    sizes: ClassVar = {"transition": (0.3e6, 1.5e6)}

    drawn = False
    name: Literal["laminar_orifice"]
    transition: Pressure = Field(gt=0)
    form: Literal["smooth", "cubic", "tanh"] = "smooth"

    def apply(self, t: Tables) -> None:
        t.bench["laminar"] = self.transition
        t.bench["laminar_form"] = self.forms.index(self.form)


class SpoolOffset(JointEffect):
    """The edges' null lies at this LVDT voltage."""

    sizes: ClassVar = {"voltage": (2e-3, 10e-3)}
    signed = ("voltage",)

    name: Literal["spool_offset"]
    voltage: Voltage

    def apply(self, t: Tables) -> None:
        t.joints["null"][self.joint] += self.voltage


class SpoolLag(JointEffect):
    """The metered opening follows the LVDT with this time constant."""

    sizes: ClassVar = {"time": (1e-3, 5e-3)}

    name: Literal["spool_lag"]
    time: Time = Field(ge=2e-4)

    def apply(self, t: Tables) -> None:
        t.joints["opening_rate"][self.joint] = 1.0 / self.time


class SpoolHysteresis(JointEffect):
    """The metered opening follows the LVDT with play of this width, half of it either way.

    ``backlash`` is the play itself; ``friction`` a dry contact whose force grows with the travel
    since the last reversal, over a third of the width (no corner).
    """

    sizes: ClassVar = {"width": (1e-3, 4e-3)}
    name: Literal["spool_hysteresis"]
    width: Voltage = Field(gt=0)
    form: Literal["backlash", "friction"] = "backlash"

    def apply(self, t: Tables) -> None:
        t.joints["play"][self.joint] += self.width
        t.joints["play_travel"][self.joint] = self.width / 3.0 if self.form == "friction" else 0.0
