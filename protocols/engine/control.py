"""What a person may ask of a run: pause, resume, skip, abort, answer; judged by the state.

A request is accepted or refused at once, in one line. What was accepted is done at the next safe
point: between two records, or within a tenth of a second where nothing moves. An abort does not
wait for one: the outputs go to zero with the next block.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.engine.states import EngineState, StateMachine
from rig.bench.screens.commands import Command


@dataclass
class Wishes:
    """What was asked and not yet done."""

    pause: bool = False
    resume: bool = False
    skip: bool = False
    abort: str = ""
    answer: str | None = None


class RunControl:
    """Judges the commands of screens; the engine takes what they wish."""

    def __init__(self, machine: StateMachine) -> None:
        self.wishes = Wishes()
        self.answers: tuple[str, ...] = ()  # of the open prompt
        self._machine = machine

    def accept(self, command: Command) -> str | None:
        """Take a command; returns None, or in one line why it is refused."""
        state = self._machine.state
        if state in (EngineState.SAFE, EngineState.TRIPPED):
            return f"the run is over ({state}); nothing can be asked of it"
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
        if self.wishes.pause:
            return "a pause is asked for already; it comes at the end of the record"
        self.wishes.pause = True
        return None

    def _resume(self, command: Command, state: EngineState) -> str | None:
        if state is not EngineState.PAUSED:
            if self.wishes.pause:
                self.wishes.pause = False  # taken back before it came
                return None
            return f"the run is not paused but {state}"
        self.wishes.resume = True
        return None

    def _skip(self, command: Command, state: EngineState) -> str | None:
        if state is EngineState.CHECKING:
            return "nothing runs yet that could be skipped"
        self.wishes.skip = True
        return None

    def _abort(self, command: Command, state: EngineState) -> str | None:
        self.wishes.abort = f"aborted by {command.holder or 'the operator'} (from the screen)"
        return None

    def _answer(self, command: Command, state: EngineState) -> str | None:
        if state is not EngineState.PROMPTING:
            return f"nothing is asked now; the run is {state}"
        if command.value not in self.answers:
            return f"{command.value!r} is no answer; expected one of: {', '.join(self.answers)}"
        self.wishes.answer = command.value
        return None
