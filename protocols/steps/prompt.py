"""Asking a person."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from protocols.steps.base import Actions, PlannedStep, Planner, Question, StepKind
from rig.model.quantity import Time


def _word(value: Any) -> Any:
    """Return YAML's true and false as yes and no."""
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value


_WORD_OR_YES = WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "boolean"}]})
Word = Annotated[str, BeforeValidator(_word), _WORD_OR_YES]


class PromptStep(StepKind):
    """Ask, outputs at zero, and wait for an answer.

    A person answers at a terminal or from a screen; unattended, `default` is used after `timeout`,
    and without a default the run ends.
    """

    key: ClassVar[str] = "prompt"

    prompt: str = Field(min_length=1, max_length=500)
    answers: tuple[Word, ...] = Field(default=("yes", "no"), min_length=1)
    default: Word | None = Field(default=None, description="counts after the time-out, unattended")
    timeout: Time = Field(gt=0, description="for an answer when unattended")
    abort_on: tuple[Word, ...] = Field(default=("no",), description="answers that end the run")

    @model_validator(mode="after")
    def _default_is_an_answer(self) -> Self:
        if self.default is not None and self.default not in self.answers:
            raise ValueError(f"default {self.default!r} is none of: {', '.join(self.answers)}")
        return self

    def plan(self, planner: Planner) -> PlannedStep:
        """Describe the question."""
        default = f"{self.default!r}" if self.default else "the run ends"
        title = f"ask {self.prompt!r}; unanswered for {self.timeout:g} s: {default}"
        return PlannedStep(self, title, 0.0, most=self.timeout)

    def run(self, planned: PlannedStep, actions: Actions) -> None:
        """Ask the operator; end the run at an answer of `abort_on`."""
        question = Question(self.prompt, self.answers, self.default, self.timeout)
        answer = actions.ask(question)
        if answer in self.abort_on:
            actions.end(f"{self.prompt!r} was answered {answer!r}")
