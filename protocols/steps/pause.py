"""A rest of stated length."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind
from rig.model.quantity import Time


class PauseStep(StepKind):
    """Rest with all outputs at zero, then go on."""

    key: ClassVar[str] = "pause"

    pause: Time = Field(gt=0, description="how long")

    def plan(self, planner: Planner) -> PlannedStep:
        """State its time."""
        return PlannedStep(self, f"rest {self.pause:g} s, outputs at zero", self.pause)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Rest."""
        actions.rest(self.pause, planned.title)
