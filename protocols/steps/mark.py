"""A line in the run's log."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind


class MarkStep(StepKind):
    """Write a line into the run's log at this time."""

    key: ClassVar[str] = "mark"

    mark: str = Field(min_length=1, max_length=500)

    def plan(self, planner: Planner) -> PlannedStep:
        """State the line."""
        return PlannedStep(self, f"mark {self.mark!r}", 0.0)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Write the line."""
        actions.mark(self.mark)
