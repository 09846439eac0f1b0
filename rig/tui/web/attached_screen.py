"""A screen as a separate process, for one page; it attaches to a run like any other screen."""

from __future__ import annotations

import asyncio
import json
import logging
import shlex
import tempfile
from asyncio.subprocess import PIPE, Process
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import IO, Final

from textual_serve.app_service import AppService
from textual_serve.download_manager import DownloadManager

from rig.queue.processes import reason_in
from rig.tui.web.page_driver import BEAT, GRACE, NAME

log = logging.getLogger(__name__)

MAX_CELLS: Final = 1000  # columns or rows of a page
CLOSED: Final = "The screen is closed. A run that it showed goes on."
_MAX_LENGTH = 4096  # of a beat's text or of an error, in characters


class AttachedScreen(AppService):
    """Starts `words` with a page for its terminal; `ended` receives one line on its end."""

    def __init__(
        self,
        words: Sequence[str],
        *,
        write_bytes: Callable[[bytes], Awaitable[None]],
        write_str: Callable[[str], Awaitable[None]],
        ended: Callable[[str], Awaitable[None]],
        downloads: DownloadManager,
    ) -> None:
        super().__init__(
            shlex.join(words),
            write_bytes=write_bytes,
            write_str=write_str,
            close=self._leaving,
            download_manager=downloads,
        )
        self._words, self._ended = tuple(words), ended
        self._stopping = False
        # Closed when the process has ended.
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115

    def _build_environment(self, width: int = 80, height: int = 24) -> dict[str, str]:
        return {**super()._build_environment(width, height), "TEXTUAL_DRIVER": NAME}

    async def _open_app_process(self, width: int = 80, height: int = 24) -> Process:
        # Without a shell, and in a separate session: a Ctrl-C at the terminal is for the server.
        self._process = process = await asyncio.create_subprocess_exec(
            *self._words,
            stdin=PIPE,
            stdout=PIPE,
            stderr=self._errors,
            env=self._build_environment(width, height),
            start_new_session=True,
        )
        # Standard error is read at its end.
        process.stderr = asyncio.StreamReader()
        process.stderr.feed_eof()
        self._stdin = process.stdin
        return process

    async def run(self) -> None:
        """Pass on the process's output until it ends, then report its end."""
        await super().run()
        assert self._process is not None
        await self._wait(self._process)
        reason = self._end_reason()
        if self._process.returncode != 0 and not self._stopping:
            log.warning("a screen ended: %s", reason)
        with suppress(ConnectionError):  # the page may be gone
            await self._ended(f"The screen ended: {reason}" if reason else CLOSED)

    async def stop(self) -> None:
        """Ask the process to end, wait, and kill it if it does not."""
        self._stopping = True
        task, self._task = self._task, None
        if task is None:
            self._errors.close()
            return
        await self._download_manager.cancel_app_downloads(app_service_id=self.app_service_id)
        await self.send_meta({"type": "quit"})
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.close()
        await self._wait(self._process)
        with suppress(TimeoutError):
            await asyncio.wait_for(task, GRACE)
        self._errors.close()

    async def set_terminal_size(self, width: int, height: int) -> None:
        """Resize the screen [characters]; raises ValueError beyond MAX_CELLS."""
        if not all(isinstance(size, int) and 0 < size <= MAX_CELLS for size in (width, height)):
            raise ValueError(f"size {width} × {height}, expected 1 to {MAX_CELLS} characters")
        await super().set_terminal_size(width, height)

    async def beat(self, mark: object) -> None:
        """Send a page's mark through the screen and back."""
        await self.send_meta({"type": BEAT, "mark": str(mark)[:_MAX_LENGTH]})

    async def on_meta(self, data: bytes) -> None:
        """Return a beat to the page; other messages are textual-serve's."""
        meta = json.loads(data)
        if meta.get("type") == BEAT:
            await self.remote_write_str(json.dumps([BEAT, meta["mark"]]))
        else:
            await super().on_meta(data)

    async def _leaving(self) -> None:
        """Give a screen that announces its end the time GRACE for it, then kill it."""
        asyncio.get_running_loop().call_later(GRACE, self._kill)

    def _kill(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.kill()

    async def _wait(self, process: Process) -> None:
        try:
            await asyncio.wait_for(process.wait(), GRACE)
        except TimeoutError:
            self._kill()
            await process.wait()

    def _end_reason(self) -> str:
        """Return why the process ended: its last error message."""
        if self._process is None or self._process.returncode == 0:
            return ""
        self._errors.seek(0)
        text = self._errors.read().decode(errors="replace")
        reason = reason_in(text) or f"with code {self._process.returncode}"
        return reason[:_MAX_LENGTH]
