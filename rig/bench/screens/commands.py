"""Commands of screens to a run, and the screen that is in control."""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Final

from rig.runs.runstate import process_alive

log = logging.getLogger(__name__)

STOP: Final = "stop"  # from any screen, at any time
ACKNOWLEDGE: Final = "acknowledge"  # an alarm by its key, without a value all; from any screen
TAKE: Final = "take"  # take control from the present holder
RELEASE: Final = "release"
PAST: Final = "past"  # the last minute and the plan, for a late screen; from any screen
CONTROLS: Final = ("pause", "resume", "skip", "abort", "answer")
BY_HAND: Final = ("jog", "lock", "unlock")  # commands of a manual session
COMMANDS: Final = (STOP, ACKNOWLEDGE, *CONTROLS, *BY_HAND, TAKE, RELEASE, PAST)

_LONGEST = 500  # largest length of a value or a holder's name [characters]


@dataclass(frozen=True)
class Command:
    """One command: its word, a value (an answer, an alarm), its sender and the sender's process."""

    word: str
    value: str = ""
    holder: str = ""
    pid: int = 0


Judge = Callable[[Command], str | None]


def own_command(word: str, value: str = "") -> Command:
    """Return a command of this process."""
    return Command(word, value, f"process {os.getpid()} on {socket.gethostname()}", os.getpid())


def to_bytes(command: Command) -> bytes:
    """Write a command as JSON: {"command", "value", "holder", "pid"}."""
    data = asdict(command)
    return json.dumps({"command": data.pop("word"), **data}).encode()


def from_bytes(raw: bytes) -> Command | None:
    """Read a command; None for anything else."""
    try:
        data = json.loads(raw)
        word, value = data["command"], data.get("value", "")
        holder, pid = data.get("holder", ""), data.get("pid", 0)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    texts = all(isinstance(text, str) and len(text) <= _LONGEST for text in (word, value, holder))
    if not texts or not isinstance(pid, int) or isinstance(pid, bool) or word not in COMMANDS:
        return None
    return Command(word, value, holder, pid)


class CommandHolder:
    """Lets one screen at a time control a run.

    The first to send a command stays in control until it releases control, ends, or another screen
    takes control.
    """

    def __init__(self) -> None:
        self._held: Command | None = None

    @property
    def held(self) -> Command | None:
        """The newest command of the screen in control; None if there is none."""
        if self._held is not None and self._held.pid and not process_alive(self._held.pid):
            self._held = None
        return self._held

    def judge(self, command: Command, judge: Judge | None) -> str | None:
        """Return None if the command is accepted, else the reason in one line."""
        if command.word in (STOP, ACKNOWLEDGE, PAST):
            return None
        refusal = self._refusal(command, judge)
        if refusal is None:
            self._held = None if command.word == RELEASE else command
        return refusal

    def _refusal(self, command: Command, judge: Judge | None) -> str | None:
        held = self.held
        if not command.holder:
            return f"{command.word}: the key 'holder' is missing; expected the name of the sender"
        if command.word == TAKE:
            return None
        if held is not None and held.holder != command.holder:
            return f"{held.holder} is in control; take control, or wait for its release"
        if command.word == RELEASE:
            return None
        if judge is None:
            return f"{command.word}: this run accepts no command but stop"
        return judge(command)
