"""Locking joints for the steps that follow."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind
from protocols.steps.excite import MOVE_SECONDS
from protocols.steps.parts import Lock, require_one_role


class LockStep(StepKind):
    """Prove that joints lock, and lock them in all later steps that do not name them."""

    key: ClassVar[str] = "lock"
    rank: ClassVar[int] = 2  # other kinds may have locks too

    lock: tuple[Lock, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _one_role_per_joint(self) -> Self:
        require_one_role(self.name or self.key, tuple(part.joint for part in self.lock))
        return self

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the locks and keep them for later steps."""
        planner.locked(self.lock)
        locks = planner.locks(self, self.lock)
        title = ", ".join(f"joint {p.joint + 1} {p.at}" for p in locks)
        return PlannedStep(self, f"lock {title}", (MOVE_SECONDS + 2.0) * len(locks), locks=locks)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Lock them once."""
        actions.lock(planned, planned.locks)
