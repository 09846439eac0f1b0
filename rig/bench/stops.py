"""Ctrl-C, SIGTERM and a closed terminal as a flag that the exchange loop reads."""

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
    """A request to stop, from a signal or a command.

    A signal only sets the flag: an exception raised by the handler could interrupt the zeroing of
    the outputs. `restore` puts the previous handlers back.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def request(self, reason: str) -> None:
        """Request a stop; the first reason is kept."""
        if self.reason is None:
            self.reason = reason

    def install(self) -> None:
        """Install the handlers; does nothing outside Python's main thread, which alone can.

        A signal that the previous handler has `heard`, and that ended nothing, is a request too.
        """
        if threading.current_thread() is not threading.main_thread() or self._previous:
            return
        for number in _SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # nohup: a run that shall outlive its terminal
            previous = self._previous[number] = signal.signal(number, self._heard)
            if getattr(previous, "heard", False):
                self.request(_REASONS[number])

    def restore(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            # None: a handler that was not set from Python; replaced by the default
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._previous = {}

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.request(_REASONS[signal.Signals(number)])
