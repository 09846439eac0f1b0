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
RELEASE: Final = "release"
CONTROLS: Final = ("pause", "resume", "skip", "abort", "answer")
COMMANDS: Final = (STOP, ACKNOWLEDGE, *CONTROLS, RELEASE)

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


class Holder:
    """Lets one screen at a time command a run: the first to do so, until it releases or is gone."""

    def __init__(self) -> None:
        self._held: Command | None = None

    def judge(self, command: Command, judge: Judge | None) -> str | None:
        """Return None where the command is taken, else in one line why it is refused."""
        if command.word in (STOP, ACKNOWLEDGE):
            return None
        held = self._held
        if held is not None and held.pid and not process_alive(held.pid):
            held = self._held = None
        if held is not None and held.holder != command.holder:
            return f"the controls are held by {held.holder}; it must release them first"
        if command.word == RELEASE:
            self._held = None
            return None
        if not command.holder:
            return f"{command.word}: say who asks ('holder'), so that one screen has the controls"
        if judge is None:
            return f"{command.word}: this run takes no commands but stop"
        refusal = judge(command)
        if refusal is None:
            self._held = command
        return refusal
