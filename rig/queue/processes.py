"""Verbs of `bramah` as child processes: started, watched, asked to end; what they said."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import IO, Any, Final

from rig.model.trips import OperatorStop
from rig.queue.locks import LockFile

BRAMAH: Final = (sys.executable, "-c", "from rig.cli.main import run; run()")
_SAID = "bramah: "  # begins the one line in which a verb says why it failed
_TAIL = 1 << 16  # [bytes] of a log that are searched for it
_POLL = 0.05  # [s]


@dataclass(frozen=True)
class ProcessResult:
    """How a verb ended: exit code, result on standard output, and the line that says why."""

    code: int
    output: str
    reason: str

    def as_json(self) -> Any:
        """Return its JSON result, None if there is none."""
        try:
            return json.loads(self.output)
        except ValueError:
            return None


def reason_in(text: str) -> str:
    """Return the last lines in which a verb said why it ended, joined by ';', '' if it did not."""
    lines = [line.partition(_SAID) for line in text.splitlines()]
    while lines and not lines[-1][1]:
        lines.pop()
    reason_lines = list(takewhile(lambda parts: parts[1], reversed(lines)))
    said = [reason.replace("\033[0m", "").strip() for _, _, reason in reversed(reason_lines)]
    return "; ".join(said)


def reason_of(path: Path) -> str:
    """Return why a process ended from the end of its log, '' if it did not say."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - _TAIL))
            return reason_in(stream.read().decode(errors="replace"))
    except OSError:
        return ""


def start(
    words: Sequence[str], output: IO[bytes], errors: IO[bytes] | int, lock: LockFile | None = None
) -> subprocess.Popen[bytes]:
    """Start a program in a session of its own: a Ctrl-C at the terminal is not for it.

    With `lock` the child holds it to its end, and this process no longer does.
    """
    inherited = () if lock is None else (lock.fileno(),)
    try:
        return subprocess.Popen(
            list(words), stdin=subprocess.DEVNULL, stdout=output, stderr=errors,
            start_new_session=True, pass_fds=inherited,
        )  # fmt: skip
    finally:
        if lock is not None:
            lock.close()


def ask_to_end(pid: int) -> None:
    """Send the signal on which a run zeroes its outputs first; a process that is gone is fine."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGINT)


def call(
    program: Sequence[str], words: Sequence[str], seconds: float,
    stopped: Callable[[], str | None] = lambda: None,
) -> ProcessResult:  # fmt: skip
    """Run a verb that moves nothing to its end; raises OperatorStop where `stopped` says why.

    After `seconds` it is killed: the answer then has code -9 and says so.
    """
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        child = start([*program, *words], output, errors)
        late = False
        try:
            deadline = time.monotonic() + seconds
            while child.poll() is None:
                why = stopped()
                if why is not None:
                    raise OperatorStop(why)
                if time.monotonic() > deadline:
                    late = True
                    break
                time.sleep(_POLL)
        finally:
            if child.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        output.seek(0)
        errors.seek(0)
        said = errors.read().decode(errors="replace")
        result = output.read().decode(errors="replace")
    reason = f"no end within {seconds:.0f} s" if late else reason_in(said)
    if not reason and child.returncode:
        reason = (
            f"ended with {child.returncode}: {(said.strip().splitlines() or ['no message'])[-1]}"
        )
    return ProcessResult(child.returncode, result, reason)
