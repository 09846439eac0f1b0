"""Commands of screens on their way to a run, and who holds the controls."""

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

STOP: Final = "stop"  # anyone may, always
ACKNOWLEDGE: Final = "acknowledge"  # an alarm by its key, without a value all; anyone may
TAKE: Final = "take"  # the controls, from whoever holds them
RELEASE: Final = "release"
PAST: Final = "past"  # the last minute and the plan, for a screen that attaches late; anyone may
CONTROLS: Final = ("pause", "resume", "skip", "abort", "answer")
BY_HAND: Final = ("jog", "lock", "unlock")  # what a manual session takes
COMMANDS: Final = (STOP, ACKNOWLEDGE, *CONTROLS, *BY_HAND, TAKE, RELEASE, PAST)

_LONGEST = 500  # characters of a value or a holder's name


@dataclass(frozen=True)
class Command:
    """One command: its word, a value (an answer, an alarm), who sends it and from which process."""

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
    """Lets one screen at a time command a run.

    The first to do so holds the controls until it releases them, is gone, or another takes them.
    """

    def __init__(self) -> None:
        self._held: Command | None = None

    @property
    def held(self) -> Command | None:
        """The newest command of the screen that holds the controls; None where they are free."""
        if self._held is not None and self._held.pid and not process_alive(self._held.pid):
            self._held = None
        return self._held

    def judge(self, command: Command, judge: Judge | None) -> str | None:
        """Return None where the command is taken, else in one line why it is refused."""
        if command.word in (STOP, ACKNOWLEDGE, PAST):
            return None
        refusal = self._refusal(command, judge)
        if refusal is None:
            self._held = None if command.word == RELEASE else command
        return refusal

    def _refusal(self, command: Command, judge: Judge | None) -> str | None:
        held = self.held
        if not command.holder:
            return f"{command.word}: say who asks ('holder'), so that one screen has the controls"
        if command.word == TAKE:
            return None
        if held is not None and held.holder != command.holder:
            return f"the controls are held by {held.holder}; take them, or wait for their release"
        if command.word == RELEASE:
            return None
        if judge is None:
            return f"{command.word}: this run takes no commands but stop"
        return judge(command)
