"""Faults of the machine: a stuck spool, a burst hose, a pump that stops, a joint that yields."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hil_sim.effects.base import Tables
from hil_sim.effects.fluid import Conductance
from hil_sim.faults.base import Fault, Restore, set_field
from rig.model.quantity import Flow


class JointFault(Fault):
    """A fault of one joint's machine; `where` is ``joint I``."""

    where: str = Field(pattern=r"^joint [1-9]$")

    @property
    def joint(self) -> int:
        """Its joint, 0-based."""
        return int(self.where.split()[1]) - 1


class ValveStuck(JointFault):
    """The spool stays at its position, whatever the output."""

    name: Literal["valve_stuck"]

    def begin(self, tables: Tables) -> Restore:
        """Set the spool's speed limit to zero."""
        return set_field(tables.joints[self.joint : self.joint + 1], "spool_rate", 0.0)


class HoseBurst(JointFault):
    """A chamber's hose bursts: oil leaves it through a wide laminar opening."""

    name: Literal["hose_burst"]
    chamber: Literal["cap", "rod"] = "cap"
    conductance: Conductance = Field(default=2e-10, gt=0)

    def begin(self, tables: Tables) -> Restore:
        """Open the chamber to the outside."""
        row = tables.joints[self.joint : self.joint + 1]
        return set_field(row, f"leak_{self.chamber}", self.conductance)


class JointUnlocks(JointFault):
    """The valve no longer holds the piston: oil passes from one chamber to the other."""

    name: Literal["joint_unlocks"]
    conductance: Conductance = Field(default=1e-10, gt=0)

    def begin(self, tables: Tables) -> Restore:
        """Connect the chambers."""
        row = tables.joints[self.joint : self.joint + 1]
        return set_field(row, "leak_internal", self.conductance)


class PumpOff(Fault):
    """The pump stops, or delivers only `flow`."""

    name: Literal["pump_off"]
    flow: Flow = Field(default=0.0, ge=0)

    def begin(self, tables: Tables) -> Restore:
        """Reduce the pump's flow."""
        return set_field(tables.bench, "pump", self.flow)
