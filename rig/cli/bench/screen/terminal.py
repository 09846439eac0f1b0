"""`bramah monitor` as a process in a pseudo-terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from rig.queue.processes import BRAMAH

SIZE: Final = (120, 40)
SESSIONS: Final = "bramah"  # the folder of sockets within $XDG_RUNTIME_DIR
_STYLE: Final = re.compile(rb"\x1b\[[0-9;:]*m")
_CONTROL: Final = re.compile(rb"\x1b\[[0-9;?<>=]*[a-ln-zA-Z]|\x1b[()][0-9A-B]|\x1b[=>78]")


@dataclass
class Screen:
    """A running screen: its process, and its output with the arrival time of each piece.

    `runtime` is the folder of its runs' sockets. As a context manager, kills the process.
    """

    runtime: Path
    drawn: list[tuple[float, bytes]] = field(default_factory=list)
    _closing: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> Self:
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(self.runtime), "TERM": "xterm-256color"}
        environment.pop("NO_COLOR", None)
        self._terminal, outer = pty.openpty()
        columns, rows = SIZE
        fcntl.ioctl(outer, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self._process = subprocess.Popen(
            [*BRAMAH, "monitor"], stdin=outer, stdout=outer, stderr=outer, env=environment,
            start_new_session=True,
        )  # fmt: skip
        os.close(outer)
        self._reader = threading.Thread(target=self._read, name="bench-terminal", daemon=True)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._closing.set()
        self._reader.join()
        os.close(self._terminal)

    @property
    def pid(self) -> int:
        """The id of the screen's process."""
        return self._process.pid

    def press(self, key: str) -> float:
        """Write a key to the terminal; return the monotonic time [s] just before."""
        at = time.monotonic()
        os.write(self._terminal, key.encode())
        return at

    def _read(self) -> None:
        while not self._closing.is_set():
            if not select.select([self._terminal], [], [], 0.1)[0]:
                continue
            try:
                piece = os.read(self._terminal, 1 << 16)
            except OSError:  # the screen has closed the other end
                return
            self.drawn.append((time.monotonic(), piece))

    def bytes_since(self, moment: float) -> int:
        """Return the number of bytes written since a monotonic time [s]."""
        return sum(len(piece) for at, piece in list(self.drawn) if at >= moment)

    def texts(self, first: float, last: float) -> list[tuple[float, str]]:
        """Return (monotonic time [s], text without styles) of the output between two times."""
        pieces = [(at, piece) for at, piece in list(self.drawn) if first <= at <= last]
        return [(at, _plain(piece)) for at, piece in pieces]

    def processor_seconds(self) -> float:
        """Return the processor time [s] of the process (Linux)."""
        fields = Path(f"/proc/{self.pid}/stat").read_text("ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _plain(piece: bytes) -> str:
    return _CONTROL.sub(b"\n", _STYLE.sub(b"", piece)).decode(errors="replace")
