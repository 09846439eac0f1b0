"""Locks that the kernel releases when their holder dies, at whatever moment that is.

A number in a file can be left behind by a killed process and then belong to another; a lock on an
open file cannot. A child inherits the lock of its item, so that a runner started later can ask
whether the item's process still lives, even one whose number was never written down.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path


class LockFile:
    """A lock file, held while this object (or a child that inherited `fileno`) is open."""

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle: int | None = handle

    @classmethod
    def take(cls, path: Path) -> LockFile | None:
        """Take the lock and write this process's number into it; None if another has it."""
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
        """Return the descriptor that a child may inherit."""
        assert self._handle is not None
        return self._handle

    def close(self) -> None:
        """Close this process's handle; the lock goes with the last one. Twice is harmless."""
        handle, self._handle = self._handle, None
        if handle is not None:
            os.close(handle)


def held(path: Path) -> bool:
    """Whether a living process has the lock."""
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
    """Return the number that the last holder wrote, None if there is none."""
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text(encoding="ascii"))
    return None
