"""What stands on the disk: runs, protocols and the queue, read beside the screen."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Browsed:
    """What was found; empty until somebody looks."""
