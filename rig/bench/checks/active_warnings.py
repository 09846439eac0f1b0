"""Active warnings: each ends when its cause has been absent for long enough."""

from __future__ import annotations

from collections.abc import Iterable

from rig.model.trips import Violation

Key = tuple[str, str, int | None]


def key_of(violation: Violation) -> Key:
    """Return the key of a violation's warning: limit, channel, joint."""
    return violation.limit, violation.channel, violation.joint


class ActiveWarnings:
    """The active warnings of a guard by key, each with its first violation."""

    def __init__(self, patience: int) -> None:
        """End a warning after `patience` samples without its cause."""
        self._patience = patience
        self._last: dict[Key, int] = {}
        self.warnings: dict[Key, Violation] = {}

    def add(self, violations: Iterable[Violation], now: int) -> None:
        """Add the violations up to tick `now`; an active warning keeps its first violation."""
        for violation in violations:
            key = key_of(violation)
            self.warnings.setdefault(key, violation)
            self._last[key] = now

    def keep(self, channel: str, limit: str, now: int) -> None:
        """Keep an active warning whose value is inside its band, but within the hysteresis."""
        for key in self.warnings:
            if key[:2] == (limit, channel):
                self._last[key] = now

    def expire(self, now: int) -> None:
        """End the warnings whose cause has been absent for `patience` samples."""
        if not self._last:
            return
        for key, last in list(self._last.items()):
            if now - last >= self._patience:
                del self._last[key], self.warnings[key]
