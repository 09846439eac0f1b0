"""Verbs of `bramah` as child processes: start, end, results and error messages; lock files.

A process id left in a file by a killed process may later belong to another process; a lock on an
open file cannot: the kernel releases it when its holder dies. An item's process inherits the item's
lock, so that a later runner can determine whether it still runs, even if its id was not stored.
"""

from __future__ import annotations

import contextlib
import fcntl
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

BRAMAH: Final = (sys.executable, "-c", "from rig.cli.main import run; run()")
_PREFIX = "bramah: "  # begins the lines with which a verb reports its error
_TAIL = 1 << 16  # [bytes] at the end of a log that are searched for these lines
_POLL = 0.05  # [s]


class LockFile:
    """A lock file, held while this object (or a child that inherited `fileno`) is open."""

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle: int | None = handle

    @classmethod
    def take(cls, path: Path) -> LockFile | None:
        """Take the lock and write this process's id into it; None if another process holds it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return None
        except OSError:
            os.close(handle)
            raise
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
        return cls(path, handle)

    def fileno(self) -> int:
        """Return the file descriptor for a child to inherit."""
        assert self._handle is not None
        return self._handle

    def close(self) -> None:
        """Close this process's handle, repeatedly if need be; the last handle releases the lock."""
        handle, self._handle = self._handle, None
        if handle is not None:
            os.close(handle)


def held(path: Path) -> bool:
    """Return whether a running process holds the lock."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


def holder(path: Path) -> int | None:
    """Return the process id of the last holder, None if there is none."""
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text(encoding="ascii"))
    return None


@dataclass(frozen=True)
class ProcessResult:
    """Result of a verb: exit code, standard output, and error message."""

    code: int
    output: str
    reason: str

    def as_json(self) -> Any:
        """Return the JSON result, None if there is none."""
        try:
            return json.loads(self.output)
        except ValueError:
            return None


def reason_in(text: str) -> str:
    """Return the last error messages of a verb, joined by ';', '' if there are none."""
    lines = [line.partition(_PREFIX) for line in text.splitlines()]
    while lines and not lines[-1][1]:
        lines.pop()
    reason_lines = list(takewhile(lambda parts: parts[1], reversed(lines)))
    messages = [reason.replace("\033[0m", "").strip() for _, _, reason in reversed(reason_lines)]
    return "; ".join(messages)


def reason_of(path: Path) -> str:
    """Return the error message at the end of a process's log, '' if there is none."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - _TAIL))
            return reason_in(stream.read().decode(errors="replace"))
    except OSError:
        return ""


def start(
    words: Sequence[str], output: IO[bytes], errors: IO[bytes] | int, lock: LockFile | None = None
) -> subprocess.Popen[bytes]:
    """Start a program in a separate session, which Ctrl-C at the terminal does not reach.

    The child takes over `lock`, if given, and holds it to its end.
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
    """Send SIGTERM, on which a run zeroes its outputs and ends; ignores an ended process."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGTERM)


def call(
    program: Sequence[str], words: Sequence[str], seconds: float,
    stopped: Callable[[], str | None] = lambda: None,
) -> ProcessResult:  # fmt: skip
    """Run a verb without motion to its end; raises OperatorStop if `stopped` returns a reason.

    After `seconds` it is killed, and the result has the code -9.
    """
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        child = start([*program, *words], output, errors)
        timed_out = False
        try:
            deadline = time.monotonic() + seconds
            while child.poll() is None:
                why = stopped()
                if why is not None:
                    raise OperatorStop(why)
                if time.monotonic() > deadline:
                    timed_out = True
                    break
                time.sleep(_POLL)
        finally:
            if child.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        output.seek(0)
        errors.seek(0)
        error_text = errors.read().decode(errors="replace")
        result = output.read().decode(errors="replace")
    reason = f"did not end within {seconds:.0f} s" if timed_out else reason_in(error_text)
    if not reason and child.returncode:
        last_line = (error_text.strip().splitlines() or ["no message"])[-1]
        reason = f"ended with {child.returncode}: {last_line}"
    return ProcessResult(child.returncode, result, reason)
