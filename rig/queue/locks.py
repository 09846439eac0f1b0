"""Lock files, which the kernel releases when their holder dies.

A process id left in a file by a killed process may later belong to another process; a lock on an
open file cannot. An item's process inherits the item's lock, so that a later runner can determine
whether it still runs, even if its id was not stored.
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
