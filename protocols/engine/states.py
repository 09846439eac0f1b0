"""The states of a run, their transitions, and reasons for an early end.

    idle        outputs at zero; between two steps
    checking    the plan is proved on the twin; no device is connected
    homing      pistons are brought to their places and locks
    locked      joints are held; none is excited
    exciting    waveforms are played
    paused      outputs at zero until a person resumes
    prompting   outputs at zero until a person answers
    tripped     a safety limit was passed; outputs at zero, the trip latched
    safe        outputs confirmed at zero; the run is over

Only `homing` leads from rest to motion, and only from `idle`: after an interruption, positioning
and locking are repeated. A session refuses every output law in a state of rest, so that nothing can
move in a forgotten pause.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final

log = logging.getLogger(__name__)


class EngineState(StrEnum):
    """A state of the engine."""

    IDLE = "idle"
    CHECKING = "checking"
    HOMING = "homing"
    LOCKED = "locked"
    EXCITING = "exciting"
    PAUSED = "paused"
    PROMPTING = "prompting"
    TRIPPED = "tripped"
    SAFE = "safe"


_ENDS = frozenset({EngineState.TRIPPED, EngineState.SAFE})
TRANSITIONS: Final[Mapping[EngineState, frozenset[EngineState]]] = {
    EngineState.IDLE: frozenset(
        {EngineState.CHECKING, EngineState.HOMING, EngineState.PAUSED, EngineState.PROMPTING}
    )
    | _ENDS,
    EngineState.CHECKING: frozenset({EngineState.IDLE, EngineState.SAFE}),
    EngineState.HOMING: frozenset({EngineState.LOCKED, EngineState.EXCITING, EngineState.IDLE})
    | _ENDS,
    EngineState.LOCKED: frozenset({EngineState.HOMING, EngineState.EXCITING, EngineState.IDLE})
    | _ENDS,
    EngineState.EXCITING: frozenset({EngineState.IDLE}) | _ENDS,
    EngineState.PAUSED: frozenset({EngineState.IDLE}) | _ENDS,
    EngineState.PROMPTING: frozenset({EngineState.IDLE}) | _ENDS,
    EngineState.TRIPPED: frozenset({EngineState.SAFE}),
    EngineState.SAFE: frozenset(),
}
ENERGISED: Final = frozenset({EngineState.HOMING, EngineState.LOCKED, EngineState.EXCITING})

OnChange = Callable[[EngineState, EngineState, str], None]


class StateMachine:
    """The state of one run; changes are passed to a listener, earlier ones when it is added."""

    def __init__(self) -> None:
        self._state = EngineState.IDLE
        self._listener: OnChange | None = None
        self._early: list[tuple[EngineState, EngineState, str]] = []

    @property
    def state(self) -> EngineState:
        """The present state."""
        return self._state

    def to(self, state: EngineState, why: str = "") -> None:
        """Change the state; raises RuntimeError for an invalid transition."""
        if state is self._state:
            return
        if state not in TRANSITIONS[self._state]:
            raise RuntimeError(f"state {self._state} cannot change to {state} ({why})")
        before, self._state = self._state, state
        log.info("%s -> %s: %s", before, state, why)
        if self._listener is None:
            self._early.append((before, state, why))
        else:
            self._listener(before, state, why)

    def listen(self, listener: OnChange) -> None:
        """Pass every change to `listener`, earlier ones first."""
        self._listener = listener
        early, self._early = self._early, []
        for before, after, why in early:
            listener(before, after, why)


class ProtocolAborted(Exception):
    """The bench did not do what a step needs; the message names joint, measured, expected.

    The bench zeroes the outputs, as at any other end of a run.
    """


class LockFailed(ProtocolAborted):
    """A locked joint moved; `joint` is 1-based, lengths in m."""

    def __init__(self, step: str, joint: int, what: str, measured: float, expected: str) -> None:
        super().__init__(step, joint, what, measured, expected)  # so that it can be pickled
        self.step = step
        self.joint = joint
        self.what = what
        self.measured = measured
        self.expected = expected

    def __str__(self) -> str:
        """Name the step, the joint, what happened, and the piston measured and expected."""
        return (
            f"lock failed in {self.step}: joint {self.joint} {self.what}: piston measured at "
            f"{1e3 * self.measured:.2f} mm, expected {self.expected}"
        )


class RunEnded(ProtocolAborted):
    """A person, or a default answer, ended the run; no rule of the protocol continues it."""
