"""How long a simulated bench lives: what every server of it, on whatever wire, has in common."""

from __future__ import annotations

import os
from typing import Final

PARENT_SECONDS: Final = 0.25  # between two looks at the parent


class EndpointError(Exception):
    """The bench cannot be offered there; the message names the place and what to do."""


class Owner:
    """The process that a server belongs to and ends with."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._child = os.getppid() == pid

    def has_ended(self) -> bool:
        """Whether the process is gone."""
        # A child's view of its parent is safe from a process number used again.
        return os.getppid() != self._pid if self._child else not _exists(self._pid)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
