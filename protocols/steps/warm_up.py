"""Moving the machine until its oil is warm."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind, StepName
from protocols.steps.excite import MOVE_SECONDS
from protocols.steps.parts import Excite, Lock
from rig.model.quantity import Time


class WarmUpStep(StepKind):
    """Excite joints, without records, until a condition holds."""

    key: ClassVar[str] = "warm_up"

    name: StepName = "warm_up"
    warm_up: str = Field(description="condition, like 'oil_temperature > 40 degC'")
    timeout: Time = Field(gt=0, description="after which the step has failed")
    move: tuple[Excite, ...] = Field(min_length=1, description="what moves the oil")
    lock: tuple[Lock, ...] = ()
    ramp: Time = Field(default=2.0, gt=0, description="the waveform grows to full size in [s]")
    settle: Time = Field(default=1.0, gt=0, description="at rest before a lock counts [s]")

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the motion and the condition."""
        condition = planner.condition(self.warm_up)
        step = planner.excitation(self)
        rate = planner.rig.sample_rate
        positioning = MOVE_SECONDS * (1 + len(step.locks)) + step.samples(rate) / rate
        title = f"move until {condition.text}, at most {self.timeout:g} s"
        longest = positioning + self.timeout
        return PlannedStep(self, title, positioning, (step,), condition=condition, most=longest)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Move until the condition holds."""
        assert planned.condition is not None
        if not actions.excite_until(planned, planned.condition, self.timeout):
            values = actions.readings(planned.condition)
            actions.fail(
                f"{self.warm_up} did not come within {self.timeout:g} s of moving: {values}"
            )
