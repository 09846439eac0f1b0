"""Inputs of a run besides the bench: the screen's commands, the terminal, the tracker.

A person may request a pause, a resume, a skip, an abort, or answer a prompt. A request is accepted
or refused at once, in one line, according to the state of the run, and executed at the next safe
point: between two records, or within a tenth of a second where nothing moves. An abort does not
wait for one: the outputs are zeroed with the next block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from protocols.engine.states import EngineState, StateMachine
from rig.bench.screens.commands import Command


class Estimates(Protocol):
    """The on-line estimator, as used by a run."""

    def values(self) -> Mapping[str, float]:
        """Return the estimates in SI by parameter, and `NAME.rsd`, their relative deviation."""

    def complete(self, record: str) -> bool:
        """Return whether a record is in the estimates; also True if none will follow."""


class NoEstimates:
    """No estimator: no condition on a parameter holds."""

    def values(self) -> Mapping[str, float]:
        """Return nothing."""
        return {}

    def complete(self, record: str) -> bool:
        """Return True: no estimates will follow."""
        return True


@dataclass
class OperatorRequests:
    """Requests of operators that are still to be executed."""

    pause: bool = False
    resume: bool = False
    skip: bool = False
    abort: str = ""
    answer: str | None = None


class RunControl:
    """Accepts or refuses the commands of screens and keeps their requests for the engine."""

    def __init__(self, machine: StateMachine) -> None:
        self.requests = OperatorRequests()
        self.answers: tuple[str, ...] = ()  # of the open prompt
        self._machine = machine

    def accept(self, command: Command) -> str | None:
        """Accept a command; return None, or in one line why it is refused."""
        state = self._machine.state
        if state in (EngineState.SAFE, EngineState.TRIPPED):
            return f"the run is over ({state}); it accepts no command"
        handler = {
            "pause": self._pause,
            "resume": self._resume,
            "skip": self._skip,
            "abort": self._abort,
            "answer": self._answer,
        }.get(command.word)
        if handler is None:
            return f"no command {command.word!r}; expected pause, resume, skip, abort or answer"
        return handler(command, state)

    def _pause(self, command: Command, state: EngineState) -> str | None:
        if state is EngineState.PAUSED:
            return "the run is paused already"
        if self.requests.pause:
            return "a pause is requested already; it comes at the end of the record"
        self.requests.pause = True
        return None

    def _resume(self, command: Command, state: EngineState) -> str | None:
        if state is not EngineState.PAUSED:
            if self.requests.pause:
                self.requests.pause = False  # withdrawn before it took effect
                return None
            return f"the run is not paused but {state}"
        self.requests.resume = True
        return None

    def _skip(self, command: Command, state: EngineState) -> str | None:
        if state is EngineState.CHECKING:
            return "nothing can be skipped before the first step"
        self.requests.skip = True
        return None

    def _abort(self, command: Command, state: EngineState) -> str | None:
        self.requests.abort = f"aborted by {command.holder or 'the operator'} (from the screen)"
        return None

    def _answer(self, command: Command, state: EngineState) -> str | None:
        if state is not EngineState.PROMPTING:
            return f"nothing is asked now; the run is {state}"
        if command.value not in self.answers:
            return f"{command.value!r} is no answer; expected one of: {', '.join(self.answers)}"
        self.requests.answer = command.value
        return None


@dataclass(frozen=True)
class RunInputs:
    """Inputs of a run besides the bench.

    `terminal` returns a line that a person typed, None for none; without a terminal the run is
    unattended. `longest_pause` [s] is the longest time of a pause, or of a question to a person,
    before the run ends.
    """

    machine: StateMachine = field(default_factory=StateMachine)
    control: RunControl = field(init=False)
    terminal: Callable[[], str | None] | None = None
    estimates: Estimates = field(default_factory=NoEstimates)
    longest_pause: float = 3600.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "control", RunControl(self.machine))

    @property
    def attended(self) -> bool:
        """Whether a person is at the terminal."""
        return self.terminal is not None
