"""The protocol file: frozen models that hold data in SI and reject inconsistent data.

Steps and signals are separate classes (`protocols.steps`, `protocols.signals`). What depends on the
rig (joints that exist, limits, sample rate) is checked by `protocols.files.plan`. The JSON schema
of a file is made from the same models.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from protocols.language.part import ProtocolPart
from protocols.steps import AnyStep
from protocols.steps.base import StepKind
from protocols.steps.excite import Step
from protocols.steps.lock import LockStep
from protocols.steps.parts import Place
from protocols.steps.warm_up import WarmUpStep
from rig.model.parameters import MAX_JOINTS
from rig.model.parts import Name
from rig.model.quantity import Time

VERSION: Final = 2
INCOMPLETE: Final = "incomplete"  # validation context: steps are missing, already rejected
DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_REFERENCE: Final = {"type": "string", "pattern": r"^\$[a-z][a-z0-9_]*$"}
_PLAIN: Final = ("integer", "number", "boolean")


class OnTrip(ProtocolPart):
    """Actions after a safety trip; the outputs are zeroed and the trip latched before.

    A trip always ends the run: only a person clears it.
    """

    mark: str = Field(default="", description="written into the run's log")
    record: Time = Field(
        default=2.0, ge=2.0, le=60.0, description="time of further recording, outputs at zero"
    )


class OnError(ProtocolPart):
    """Actions after a failed step: a lock that fails, a condition timed out."""

    then: Literal["stop", "skip"] = Field(
        default="stop", description="end the run, or close the valves and go on with the next step"
    )
    at_most: int = Field(default=3, ge=1, description="steps that may be skipped; then it stops")
    mark: str = Field(default="", description="written into the run's log")


class Retry(ProtocolPart):
    """How often to reconnect to a lost device; nothing else is ever retried."""

    times: int = Field(ge=1, le=20, description="in the whole run")
    wait: Time = Field(default=5.0, gt=0, description="before each attempt")


def _joints_exist(step: StepKind, info: ValidationInfo) -> StepKind:
    """Refuse a step that names a joint beyond the protocol's `joints`."""
    joints = info.data.get("joints")  # missing where it was refused itself
    for part in every_step([step]):
        absent = [joint for joint in _named_joints(part) if joints and joint > joints]
        if absent:
            raise ValueError(
                f"step {part.name or part.key!r}: joint {min(absent)} does not exist; the protocol "
                f"says joints: {joints}"
            )
    return step


class Protocol(ProtocolPart):
    """A whole experiment."""

    version: int = Field(default=VERSION, ge=1, description="of this language")
    name: Name
    description: str = ""
    joints: int = Field(ge=1, le=MAX_JOINTS, description="size of the rigs it is written for")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="values by name; `$name` stands for one in the steps"
    )
    place: Place = Place()
    steps: tuple[Annotated[AnyStep, AfterValidator(_joints_exist)], ...] = Field(min_length=1)
    on_trip: OnTrip = OnTrip()
    on_error: OnError = OnError()
    retry: Retry | None = None

    @property
    def excitations(self) -> tuple[Step, ...]:
        """The steps that take records of excited joints, nested ones too, in order."""
        return tuple(step for step in every_step(self.steps) if isinstance(step, Step))

    @field_validator("version")
    @classmethod
    def _known(cls, version: int) -> int:
        if version > VERSION:
            raise ValueError(later_version(version))
        return version

    @field_validator("steps")
    @classmethod
    def _names_differ(cls, steps: tuple[StepKind, ...]) -> tuple[StepKind, ...]:
        names: set[str] = set()
        for step in every_step(steps):
            if step.name is None:
                continue
            if step.name in names:
                raise ValueError(
                    f"two steps are called {step.name!r}; records need different names"
                )
            names.add(step.name)
        return steps

    @model_validator(mode="after")
    def _every_joint_has_a_role(self, info: ValidationInfo) -> Self:
        if info.context and info.context.get(INCOMPLETE):
            return self  # a lock may be in a step that could not be read
        joints = set(range(1, self.joints + 1))
        locked: set[int] = set()
        for step in every_step(self.steps):
            if isinstance(step, LockStep):
                locked = {part.joint for part in step.lock}
            assigned = _named_joints(step)
            idle = joints - assigned - locked
            if isinstance(step, Step | WarmUpStep) and idle:
                raise ValueError(
                    f"step {step.name!r}: joint {min(idle)} is neither locked nor "
                    "excited; say which, so that it is known where it stands"
                )
        return self


def later_version(version: int) -> str:
    """Return the error for a file of a later version."""
    return (
        f"version {version} is later than this program reads, which is {VERSION}; "
        "use a newer bramah"
    )


def every_step(steps: Sequence[StepKind]) -> Iterator[StepKind]:
    """Yield steps and those nested in them, in order."""
    for step in steps:
        yield step
        yield from every_step(getattr(step, "steps", ()))


def _named_joints(step: StepKind) -> set[int]:
    parts = (*getattr(step, "lock", ()), *getattr(step, "excite", ()), *getattr(step, "move", ()))
    return {part.joint for part in parts}


def protocol_schema() -> dict[str, Any]:
    """Return the schema; its `$id` ends in the version of the language.

    Numbers may also be references to parameters, which are texts in the file.
    """
    schema: dict[str, Any] = _with_references(Protocol.model_json_schema())
    schema["properties"]["version"] = {"type": "integer", "minimum": 1, "maximum": VERSION}
    return {"$schema": DIALECT, "$id": f"urn:bramah:protocol:{VERSION}", **schema}


def _with_references(node: Any) -> Any:
    if isinstance(node, list):
        return [_with_references(item) for item in node]
    if not isinstance(node, dict):
        return node
    if node.get("type") in _PLAIN and "const" not in node:
        about = {k: node[k] for k in ("title", "description", "default") if k in node}
        rules = {k: v for k, v in node.items() if k not in about}
        return {**about, "anyOf": [rules, _REFERENCE]}
    return {key: _with_references(value) for key, value in node.items()}
