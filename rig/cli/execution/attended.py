"""Answers typed at the terminal, and the tracker's estimates, for the engine of a run."""

from __future__ import annotations

import math
import select
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from rig.cli.text.output import is_terminal

if TYPE_CHECKING:
    from rig.cli.identification.tracking import Tracking


def terminal_lines(attended: bool | None) -> Callable[[], str | None] | None:
    """Return a function that reads a typed line without waiting; None for an unattended run.

    By default a run is attended if its standard input and standard error are terminals.
    """
    if attended is None:
        attended = is_terminal(sys.stdin) and is_terminal(sys.stderr)
    return _read_answer if attended else None


def _read_answer() -> str | None:
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    if not ready:
        return None
    line = sys.stdin.readline()
    return line.rstrip("\n") if line else None


class TrackedEstimates:
    """The tracker's estimates for a protocol's conditions (see `run_inputs.Estimates`)."""

    def __init__(self, tracking: Tracking) -> None:
        self._tracking = tracking

    def values(self) -> Mapping[str, float]:
        """Return each finite estimate [SI] and its relative standard deviation, as NAME.rsd."""
        entered: dict[str, float] = {}
        for name, estimate in self._tracking.parameters.items():
            value, std = estimate["value"], estimate["std"]
            if value is None:
                continue
            entered[name] = float(value)
            if std is not None and value:
                entered[f"{name}.rsd"] = abs(float(std) / float(value))
        return {name: value for name, value in entered.items() if math.isfinite(value)}

    def complete(self, record: str) -> bool:
        """Return whether the estimates include a record; True if the tracker has ended."""
        return not self._tracking.alive or record in self._tracking.recorded
