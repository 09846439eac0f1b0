"""The final state of an item from the end of its process."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rig.bench.outputs import UNSURE
from rig.queue import items as it
from rig.runs import runstate, store

# The exit codes of `bramah run` (the command line's contract).
_STATES: Final = {
    0: it.DONE,
    1: it.FAILED,
    2: it.REFUSED,
    3: it.TRIPPED,
    4: it.LOST,
    130: it.STOPPED,
}
_BUSY: Final = "device in use:"
_DEVICE: Final = ("device:", _BUSY)


@dataclass(frozen=True)
class ItemOutcome:
    """The final state of an item and the reason.

    Of an item that did not start: `latched`, an earlier trip prevented it; `in_use`, another
    process or computer has the bench.
    """

    state: str
    reason: str
    latched: bool = False
    in_use: bool = False

    def adding(self, reason: str) -> ItemOutcome:
        """Return the outcome with a further reason."""
        return replace(self, reason=f"{self.reason}; {reason}".removeprefix("; "))

    def as_requested(self, state: str, why: str) -> ItemOutcome:
        """Return the outcome with `state` and the reason `why` if the process ended on request."""
        if not state or self.state not in (it.STOPPED, it.FAILED):
            return self
        return ItemOutcome(state, why).adding(self.reason)


def outcome_of(code: int, reason: str, *, began: bool) -> ItemOutcome:
    """Return the outcome for an exit code; `began`: a run folder exists."""
    if code < 0:
        return ItemOutcome(it.INTERRUPTED, f"its process was killed by signal {-code}")
    if code not in _STATES:
        return ItemOutcome(it.FAILED, f"ended with {code}: {reason or 'no message'}")
    latched = code == 3 and not began
    in_use = code == 4 and not began and reason.startswith(_BUSY)
    return ItemOutcome(_STATES[code], reason if code else "", latched, in_use)


def outcome_of_folder(folder: Path, last_line: str) -> ItemOutcome:
    """Return the outcome of a process with unknown exit code, from its run folder and last line."""
    unseen = "ended while no runner was watching"
    if not store.is_run(folder):
        if not last_line:
            return ItemOutcome(
                it.INTERRUPTED, "its process was killed before anything was recorded"
            )
        return ItemOutcome(_state_of(last_line), f"{last_line}; {unseen}")
    state = runstate.read_state(folder)
    if state == runstate.DONE:
        return ItemOutcome(it.DONE, unseen)
    if state == runstate.TRIPPED:
        return ItemOutcome(it.TRIPPED, last_line or _end_message(folder) or unseen)
    if state == runstate.ABORTED:
        why = last_line or _end_message(folder)
        return ItemOutcome(_state_of(why), f"{why}; {unseen}".removeprefix("; "))
    return ItemOutcome(it.INTERRUPTED, "its process was killed while no runner watched")


def _state_of(message: str) -> str:
    """Return the state for a run's last message."""
    message = message.removeprefix(f"{UNSURE}; ")
    if message.startswith(_DEVICE):
        return it.LOST
    return it.STOPPED if message.startswith("stopped") else it.FAILED


def _end_message(folder: Path) -> str:
    ends = [e for e in runstate.read_events(folder) if e.get("event") == "end"]
    return str(ends[-1].get("message", "")) if ends else ""
