"""Repeating steps until the estimates are good enough."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind


class RepeatStep(StepKind):
    """Run `steps` repeatedly until a condition holds, `at_most` times.

    Records of a later round continue the repeat numbers of their step. Reaching `at_most` is
    logged; with `required` it is an error.
    """

    key: ClassVar[str] = "repeat_until"
    nests: ClassVar[bool] = True

    repeat_until: str = Field(description="condition, like 'b.rsd < 0.5 %'")
    at_most: int = Field(ge=1, le=1000, description="rounds")
    required: bool = Field(default=False, description="fail if it does not hold in the end")
    steps: tuple[AnyStep, ...] = Field(min_length=1)  # type: ignore[name-defined]  # noqa: F821

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the condition and the steps of a round."""
        condition = planner.condition(self.repeat_until)
        nested = planner.nested(self.steps)
        once = sum(part.seconds for part in nested)
        longest = sum(part.longest for part in nested)
        return PlannedStep(
            self,
            f"repeat {len(nested)} step(s) until {condition.text}, at most {self.at_most} times",
            once,
            nested=nested,
            condition=condition,
            most=self.at_most * longest,
        )

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Repeat the nested steps until the condition holds."""
        assert planned.condition is not None
        fulfilled = actions.repeat(planned, planned.condition, self.at_most)
        if fulfilled:
            return
        why = f"{planned.condition.text} does not hold after {self.at_most} rounds"
        if self.required:
            actions.fail(why)
        actions.mark(why)
