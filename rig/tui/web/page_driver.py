"""Textual's driver for a screen whose terminal is a page; it ends when its server is gone."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from threading import Lock, Timer
from typing import Any, Final

from textual import events, messages
from textual.drivers.web_driver import WebDriver
from textual.geometry import Size

NAME: Final = f"{__name__}:PageDriver"
BEAT: Final = "beat"  # a message that the page sends and expects back after the frames before it
# Black on yellow, grey on black: those of the page's terminal have contrasts of 5 and 2.6 only.
PALETTE: Final = "0;#000000;8;#8a8a8a"
GRACE: Final = 2.0  # time in which a screen that was asked to end does so by itself [s]


class PageDriver(WebDriver):
    """Reads keys from its server and writes frames to it, over two pipes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._writing = Lock()
        self._write = partial(self._write_packet)  # in place of Textual's bare os.write

    def _write_packet(self, packet: bytes) -> int:
        """Write a whole packet before any other thread's.

        The screen's loop writes frames, the thread of the keys writes pieces of reports; a pipe
        keeps only writes of up to 4 kB in one piece.
        """
        with self._writing:
            rest = memoryview(packet)
            while rest:
                rest = rest[os.write(self.fileno, rest) :]
        return len(packet)

    def start_application_mode(self) -> None:
        """Start drawing on the page, with colours legible from two metres."""
        super().start_application_mode()
        self.write(f"\x1b]4;{PALETTE}\x1b\\")

    def run_input_thread(self) -> None:
        """Read until the server closes the pipe or is killed; then end."""
        super().run_input_thread()
        if self.exit_event.is_set():
            return
        # A screen that hangs, or whose writes block, must not outlive its server either.
        last = Timer(GRACE, os._exit, (1,))
        last.daemon = True
        last.start()
        self._app.post_message(messages.ExitApp())

    def on_meta(self, packet_type: str, payload: dict[str, Any]) -> None:
        """Send a beat back through the screen's loop, so that its delay includes the screen's."""
        if packet_type == BEAT:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self.write_meta, payload)
        elif packet_type == "resize":
            # On the way of the size at the start, which Textual's own way can overtake.
            size = Size(payload["width"], payload["height"])
            self._size = (size.width, size.height)
            self.process_message(events.Resize(size, size))
        else:
            super().on_meta(packet_type, payload)
