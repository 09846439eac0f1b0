"""Keeping still, to record leakage and creep."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind
from protocols.steps.excite import MOVE_SECONDS
from protocols.steps.parts import CLOSED, Lock, require_one_role
from rig.model.quantity import Time


class HoldStep(StepKind):
    """Bring joints to their places, close the valves, and wait.

    With a name a record of the whole time is taken. Without locks, of this or of an earlier `lock`
    step, nothing moves: every valve stays closed.
    """

    key: ClassVar[str] = "hold"

    hold: Time = Field(gt=0, description="how long")
    lock: tuple[Lock, ...] = Field(default=(), description="where the joints are brought before")

    @model_validator(mode="after")
    def _valves_are_closed(self) -> Self:
        require_one_role(self.name or self.key, tuple(part.joint for part in self.lock))
        pushed = [part.joint for part in self.lock if part.at != CLOSED]
        if pushed:
            raise ValueError(
                f"joint {pushed[0]} is held against an end stop by a push; a hold closes every "
                "valve: expected 'at: closed'"
            )
        return self

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the places."""
        locks = planner.locks(self, self.lock)
        where = ", ".join(f"joint {p.joint + 1} at {1e3 * p.piston:g} mm" for p in locks)
        title = f"hold {self.hold:g} s, valves closed" + (f", {where}" if where else "")
        records = (f"{self.name}_r1",) if self.name else ()
        seconds = self.hold + MOVE_SECONDS * bool(locks)
        return PlannedStep(self, title, seconds, locks=locks, records=records)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Keep every valve closed for the time of the hold."""
        actions.hold(planned, planned.locks, self.hold)
