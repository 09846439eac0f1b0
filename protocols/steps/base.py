"""Base of every kind of step: data of the file, its plan on a rig, its actions at the bench.

To add one: a subclass of `StepKind` in a module of `protocols.steps`, with the key by which the
file names it. The registry, the JSON schema, `check` and the engine then know it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

from pydantic import Field

from protocols.language.conditions import Condition
from protocols.language.part import LocatedPart
from protocols.steps.plans import LockPlan, StepPlan
from rig.model.parts import MAX_NAME
from rig.model.rig import Rig

StepName = Annotated[str, Field(pattern=r"^[a-z0-9]+(?:_[a-z0-9]+)*$", max_length=MAX_NAME)]


class Planner(Protocol):
    """The resolver's interface for steps."""

    @property
    def rig(self) -> Rig:
        """The rig."""

    def condition(self, text: str) -> Condition:
        """Read a condition; InputError where the rig cannot judge it."""

    def nested(self, steps: Sequence[StepKind]) -> tuple[PlannedStep, ...]:
        """Resolve the steps within a step."""

    def locked(self, locks: Sequence[Any]) -> None:
        """Keep locks (of `protocols.steps.parts`) for the steps that follow."""

    def locks(self, step: StepKind, locks: Sequence[Any]) -> tuple[LockPlan, ...]:
        """Resolve locks; InputError naming step, joint and limit."""

    def excitation(self, step: StepKind) -> StepPlan:
        """Resolve a step that locks some joints and excites the others."""


@dataclass(frozen=True)
class PlannedStep:
    """A step resolved on a rig: title, expected time [s], excitations, nested steps.

    `most` [s] bounds the time where only the bench decides it.
    """

    step: StepKind
    title: str
    seconds: float
    excitations: tuple[StepPlan, ...] = ()
    nested: tuple[PlannedStep, ...] = ()
    locks: tuple[LockPlan, ...] = ()
    condition: Condition | None = None
    records: tuple[str, ...] = ()
    most: float | None = None

    @property
    def name(self) -> str:
        """The step's name, or its kind where it has none."""
        return self.step.name or self.step.key

    @property
    def longest(self) -> float:
        """The longest time [s]."""
        return self.seconds if self.most is None else self.most

    @property
    def all_excitations(self) -> tuple[StepPlan, ...]:
        """Its excitations and those of nested steps, in order."""
        inner = (plan for part in self.nested for plan in part.all_excitations)
        return (*self.excitations, *inner)


class Actions(Protocol):
    """The actions of a step at the bench; the engine implements it.

    Each leaves the state machine in `idle` with the outputs at zero, unless stated otherwise, and
    raises what ends the run.
    """

    def excite(self, planned: PlannedStep) -> None:
        """Place, lock, centre and take the records of the step's excitation."""

    def excite_until(self, planned: PlannedStep, condition: Condition | None, most: float) -> bool:
        """Excite without taking records until a condition holds; False after `most` seconds."""

    def hold(self, planned: PlannedStep, locks: Sequence[LockPlan], seconds: float) -> None:
        """Lock joints, keep still, and take one record if the step has a name."""

    def lock(self, planned: PlannedStep, locks: Sequence[LockPlan]) -> None:
        """Prove that joints can be locked."""

    def rest(self, seconds: float, why: str) -> None:
        """Wait with all outputs at zero."""

    def wait(self, condition: Condition, most: float) -> bool:
        """Rest until a condition holds; False after `most` seconds."""

    def readings(self, condition: Condition) -> str:
        """Return the present values of a condition's names, with units."""

    def ask(self, question: Question) -> str:
        """Ask a person, outputs at zero; returns the answer."""

    def repeat(self, planned: PlannedStep, condition: Condition, rounds: int) -> bool:
        """Run the nested steps until a condition holds; False after `rounds`."""

    def mark(self, text: str) -> None:
        """Write a line into the run's log."""

    def fail(self, why: str) -> None:
        """Fail the step with a reason; the protocol's `on_error` applies."""

    def end(self, why: str) -> None:
        """End the run with a reason, whatever `on_error` says."""


@dataclass(frozen=True)
class Question:
    """A question to the operator; `default` is used after `timeout` [s] if unattended."""

    text: str
    answers: tuple[str, ...]
    default: str | None
    timeout: float


class StepKind(LocatedPart):
    """A step of a protocol; `key` names its kind in a file."""

    key: ClassVar[str]
    rank: ClassVar[int] = 1  # kinds of lower rank are recognised first
    nests: ClassVar[bool] = False  # its key `steps` holds steps

    name: StepName | None = Field(default=None, description="of its records and log lines")

    @abstractmethod
    def plan(self, planner: Planner) -> PlannedStep:
        """Resolve the step on a rig; raises InputError naming what does not fit."""

    @abstractmethod
    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Execute the step at the bench."""


class Macro(StepKind):
    """A step that the reader replaces by others before anything is resolved."""

    def plan(self, planner: Planner) -> PlannedStep:
        """Raise an error: macros are replaced before."""
        raise TypeError(f"{self.key} is replaced when a protocol file is read")

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Raise an error: macros are never planned."""
        raise TypeError(f"{self.key} is replaced when a protocol file is read")
