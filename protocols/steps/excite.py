"""Locking some joints and exciting the others: the step with records."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from protocols.steps.base import Actions, PlannedStep, Planner, StepKind, StepName
from protocols.steps.parts import Excite, Lock, require_one_role
from rig.model.quantity import Time

MAX_REPEATS = 1000
MOVE_SECONDS = 4.0  # [s] for positioning a joint, for the estimate of the duration only


class Step(StepKind):
    """Locked and excited joints, length and number of records."""

    key: ClassVar[str] = "excite"
    rank: ClassVar[int] = 0  # it may also have the keys `lock` and `warm_up`

    name: StepName
    lock: tuple[Lock, ...] = ()
    excite: tuple[Excite, ...] = Field(min_length=1)
    repeats: int = Field(default=1, ge=1, le=MAX_REPEATS)
    duration: Time | None = Field(default=None, gt=0, description="of a record; one period if not")
    warm_up: int = Field(
        default=1, ge=1, le=1000, description="periods under the slow loop, before the first trim"
    )
    ramp: Time = Field(default=2.0, gt=0, description="the waveform grows to full size in [s]")
    settle: Time = Field(default=1.0, gt=0, description="at rest before a lock counts [s]")
    parameters: dict[str, str] = Field(
        default_factory=dict, description="of the sweep that made it; kept with its records"
    )

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints (1-based) of the step, locked ones first."""
        return (*(part.joint for part in self.lock), *(part.joint for part in self.excite))

    @model_validator(mode="after")
    def _one_role_per_joint(self) -> Self:
        require_one_role(self.name, self.joints)
        return self

    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve waveforms, locks and lengths."""
        step = planner.excitation(self)
        rate = planner.rig.sample_rate
        seconds = MOVE_SECONDS * (1 + len(step.locks)) + 2.0 * step.settle
        seconds += step.samples(rate) / rate
        moved = " and ".join(f"joint {e.joint + 1}" for e in step.excite)
        kinds = " and ".join(dict.fromkeys(e.settings.signal.kind for e in step.excite))
        held = ", ".join(f"joint {p.joint + 1} {p.at}" for p in step.locks)
        title = f"{kinds} on {moved}" + (f", {held}" if held else "")
        title += f": {step.repeats} x {step.record / rate:g} s"
        records = tuple(f"{self.name}_r{r}" for r in range(1, self.repeats + 1))
        return PlannedStep(self, title, seconds, (step,), records=records)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Take the records."""
        actions.excite(planned)
