"""Waiting for a condition, outputs at zero."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind
from rig.model.quantity import Time


class WaitStep(StepKind):
    """Rest until a condition holds; after `timeout` the protocol's `on_error` decides."""

    key: ClassVar[str] = "wait_until"

    wait_until: str = Field(description="condition, like 'oil_temperature > 40 degC'")
    timeout: Time = Field(gt=0, description="after which the step has failed")

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the condition."""
        condition = planner.condition(self.wait_until)
        title = f"wait until {condition.text}, at most {self.timeout:g} s"
        return PlannedStep(self, title, 0.0, condition=condition, most=self.timeout)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Wait."""
        assert planned.condition is not None
        if not actions.wait(planned.condition, self.timeout):
            values = actions.readings(planned.condition)
            actions.fail(
                f"{planned.condition.text} did not come within {self.timeout:g} s: {values}"
            )
