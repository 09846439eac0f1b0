"""Warnings that stand: each until its cause has been away for long enough."""

from __future__ import annotations

from collections.abc import Iterable

from rig.model.trips import Violation

Key = tuple[str, str, int | None]


def key_of(violation: Violation) -> Key:
    """Return what makes two violations the same warning: limit, channel, joint."""
    return violation.limit, violation.channel, violation.joint


class Standing:
    """The warnings of a guard by key: the first violation of each, until it has returned."""

    def __init__(self, patience: int) -> None:
        """Let a warning return after `patience` samples without its cause."""
        self._patience = patience
        self._last: dict[Key, int] = {}
        self.warnings: dict[Key, Violation] = {}

    def see(self, violations: Iterable[Violation], now: int) -> None:
        """Take the violations seen up to tick `now`; what came before keeps its first sample."""
        for violation in violations:
            key = key_of(violation)
            self.warnings.setdefault(key, violation)
            self._last[key] = now

    def keep(self, channel: str, limit: str, now: int) -> None:
        """Keep a warning that stands already: its value is back, but within the dead band."""
        for key in self.warnings:
            if key[:2] == (limit, channel):
                self._last[key] = now

    def expire(self, now: int) -> None:
        """Let go of the warnings whose cause has been away for the patience."""
        if not self._last:
            return
        for key, last in list(self._last.items()):
            if now - last >= self._patience:
                del self._last[key], self.warnings[key]
