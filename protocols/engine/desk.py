"""Where people and estimates come into a run: the screen's commands, the terminal, the tracker."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from protocols.engine.control import RunControl
from protocols.engine.states import StateMachine


class Estimates(Protocol):
    """The on-line estimator, as a run sees it."""

    def values(self) -> Mapping[str, float]:
        """Return the estimates in SI by parameter, and `NAME.rsd`, their relative deviation."""

    def complete(self, record: str) -> bool:
        """Say whether a record is in the estimates; True also where nothing more will come."""


class NoEstimates:
    """Nothing is estimated: no condition on a parameter holds."""

    def values(self) -> Mapping[str, float]:
        """Return nothing."""
        return {}

    def complete(self, record: str) -> bool:
        """Say that nothing more will come."""
        return True


@dataclass(frozen=True)
class Desk:
    """What a run needs of the world outside.

    `terminal` returns a line that a person typed, None for none; without a terminal the run is
    unattended. `longest_pause` [s] is how long a pause, or a question to someone who attends, may
    last before the run ends.
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
