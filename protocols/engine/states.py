"""The states of a run, the only ways from one to the next, and why a run ends early.

    idle        outputs at zero; between two steps
    checking    the plan is proved on the twin; no device is connected
    homing      pistons are brought to their places and locks
    locked      joints are held; none is excited
    exciting    waveforms are played
    paused      outputs at zero until a person resumes
    prompting   outputs at zero until a person answers
    tripped     a safety limit was passed; outputs at zero, the trip latched
    safe        outputs confirmed at zero; the run is over

Only `homing` leads from rest to motion, and only from `idle`: whatever was interrupted begins again
with its places and locks. A session refuses every output law in a state that is at rest, so a
pause that someone forgot cannot move anything.
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
WAYS: Final[Mapping[EngineState, frozenset[EngineState]]] = {
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
    """Holds the state of one run; every change is passed on, those before a listener are kept."""

    def __init__(self) -> None:
        self._state = EngineState.IDLE
        self._listener: OnChange | None = None
        self._early: list[tuple[EngineState, EngineState, str]] = []

    @property
    def state(self) -> EngineState:
        """The state now."""
        return self._state

    @property
    def energised(self) -> bool:
        """Whether outputs other than zero are allowed now."""
        return self._state in ENERGISED

    def to(self, state: EngineState, why: str = "") -> None:
        """Change the state; raises RuntimeError for a way that does not exist."""
        if state is self._state:
            return
        if state not in WAYS[self._state]:
            raise RuntimeError(f"no way from state {self._state} to {state} ({why})")
        before, self._state = self._state, state
        log.info("%s -> %s: %s", before, state, why)
        if self._listener is None:
            self._early.append((before, state, why))
        else:
            self._listener(before, state, why)

    def listen(self, listener: OnChange) -> None:
        """Pass every change to `listener`, beginning with those that came before it."""
        self._listener = listener
        early, self._early = self._early, []
        for before, after, why in early:
            listener(before, after, why)


class ProtocolAborted(Exception):
    """The bench did not do what the step needs; the message names joint, measured, expected.

    The bench zeroes the outputs on this as on any other end of a run.
    """


class LockFailed(ProtocolAborted):
    """A joint that was to stand still did not; `joint` is 1-based, lengths in m."""

    def __init__(self, step: str, joint: int, what: str, measured: float, expected: str) -> None:
        self.step = step
        self.joint = joint
        self.measured = measured
        self.expected = expected
        super().__init__(
            f"lock failed in {step}: joint {joint} {what}: piston measured at "
            f"{1e3 * measured:.2f} mm, expected {expected}"
        )


class RunEnded(ProtocolAborted):
    """A person, or what stands for one, ended the run; no rule of the protocol goes on after it."""
