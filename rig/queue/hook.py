"""Notifications: the user's command receives JSON on its standard input.

Each runs in a separate thread and session with a time limit: a command that hangs, fails, cannot be
started or does not read its input only causes a line in `hook.log`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rig.model.parse import InputError

log = logging.getLogger(__name__)

SECONDS = 30.0  # time limit [s] of a command, such as of a mail server's answer

IN_ORDER = 5.0  # [s] that a message waits for the previous one, which may hang


def parse_command(text: str) -> tuple[str, ...]:
    """Split a command line as a shell does; raises InputError."""
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise InputError(f"--notify {text!r}: {error}") from error
    if not words:
        raise InputError("--notify: expected a command and its arguments")
    return words


class Hook:
    """Sends notifications to a command; without one it does nothing."""

    def __init__(self, command: Sequence[str], log_file: Path, seconds: float = SECONDS) -> None:
        self._command = tuple(command)
        self._log = log_file
        self._seconds = seconds
        self._threads: list[threading.Thread] = []

    def send(self, message: Mapping[str, Any]) -> None:
        """Deliver a message in the background; never raises."""
        if not self._command:
            return
        text = json.dumps(dict(message), default=str).encode() + b"\n"
        previous = self._threads[-1] if self._threads else None
        thread = threading.Thread(
            target=self._deliver, args=(text, previous), daemon=True, name="notify"
        )
        self._threads = [t for t in self._threads if t.is_alive()] + [thread]
        thread.start()

    def wait(self) -> None:
        """Wait for the message being delivered, at most until its time limit."""
        deadline = time.monotonic() + self._seconds + 1.0
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _deliver(self, text: bytes, previous: threading.Thread | None) -> None:
        if previous is not None:
            previous.join(IN_ORDER)
        try:
            with self._log.open("ab") as output:
                self._run(text, output.fileno())
        except (OSError, ValueError) as error:
            log.warning("the notification %s was not delivered: %s", self._command[0], error)

    def _run(self, text: bytes, output: int) -> None:
        with subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=output, stderr=output,
            start_new_session=True,
        ) as child:  # fmt: skip
            try:
                child.communicate(text, timeout=self._seconds)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.pid, signal.SIGKILL)
                log.warning(
                    "the notification %s took longer than %g s and was ended",
                    self._command[0], self._seconds,
                )  # fmt: skip
        if child.returncode > 0:
            log.warning(
                "the notification %s ended with %d; see %s",
                self._command[0], child.returncode, self._log,
            )  # fmt: skip
