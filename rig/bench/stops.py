"""Ctrl-C, SIGTERM and a closed terminal as a flag that the exchange loop honours."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REASONS = {
    signal.SIGINT: "stopped by operator (Ctrl-C)",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGHUP: "stopped because the terminal closed",
}


class StopFlag:
    """A wish to stop, from a signal or a command.

    A signal sets the flag and interrupts nothing: an exception out of the handler could strike
    while the outputs are being zeroed. The previous handlers return with `restore`.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def request(self, reason: str) -> None:
        """Wish to stop; the first reason stands."""
        if self.reason is None:
            self.reason = reason

    def install(self) -> None:
        """Take over the signals; only Python's main thread may, elsewhere nothing happens."""
        if threading.current_thread() is not threading.main_thread() or self._previous:
            return
        for number in _SIGNALS:
            self._previous[number] = signal.signal(number, self._heard)

    def restore(self) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            # None: a handler that was not set from Python; the default is the nearest to it
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._previous = {}

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.request(_REASONS[signal.Signals(number)])
