"""What the operator's screen costs: processor time while a run lives and after it has ended."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from drivers.base import SampleBlock
from rig.bench.guard import EXCITED, FREE
from rig.bench.screens.display import Display
from rig.bench.screens.sockets import Publisher
from rig.cli.bench.figure import Figure
from rig.model import channels as ch
from rig.runs.rigs import load_rig

RIG: Final = "digger-3dof"  # three joints: 17 channels
SIZE: Final = (120, 40)
WARM: Final = 4.0  # until the screen has started and its caches are filled [s]
SETTLE: Final = 3.0  # until the screen has noticed the end of the run [s]
BLOCK: Final = 0.01  # of samples handed over at once [s]
LIVE_LIMIT: Final = 15.0  # [% of one core]
IDLE_LIMIT: Final = 3.0  # [% of one core]


def publish(seconds: float) -> None:
    """Show a synthetic run of 17 channels at 1 kHz to screens, in real time, then end it."""
    rig = load_rig(RIG)
    publisher = Publisher(rig.name)
    display = Display(rig, publisher, "", time.monotonic)
    roles = (EXCITED, *[FREE] * (len(rig.joints) - 1))
    count = round(BLOCK * rig.sample_rate)
    saturated = np.zeros((count, len(rig.channels)), dtype=bool)
    level = {"Pa": (3e6, 1e6), "m": (0.0, 5e-3), "V": (0.0, 0.5), "degC": (40.0, 0.1)}
    base, swing = np.array([level[ch.unit_of(name)] for name in rig.recorded]).T
    phase = np.arange(len(rig.recorded))
    began = time.monotonic()
    for k in range(round(seconds / BLOCK)):
        ticks = k * count + np.arange(count)
        wave = np.sin(2 * np.pi * ticks[:, None] / rig.sample_rate + phase)
        display.commands()
        block = SampleBlock(k, k * count, base + swing * wave, saturated, 0, False)
        display.show(block, 0.001, 0, roles)
        time.sleep(max(began + (k + 1) * BLOCK - time.monotonic(), 0.0))
    display.ended("done", "")
    display.close()


@contextmanager
def _screen(folder: str) -> Iterator[tuple[int, int]]:
    """Start `bramah monitor` in a terminal of its own; yields (process, terminal)."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": folder, "TERM": "xterm-256color"}
    environment.pop("NO_COLOR", None)
    inner, outer = pty.openpty()
    fcntl.ioctl(outer, termios.TIOCSWINSZ, struct.pack("HHHH", SIZE[1], SIZE[0], 0, 0))
    command = [sys.executable, "-c", "from rig.cli.main import run; run()", "monitor"]
    process = subprocess.Popen(
        command, stdin=outer, stdout=outer, stderr=outer, env=environment, start_new_session=True
    )
    os.close(outer)
    try:
        yield process.pid, inner
    finally:
        process.kill()
        process.wait()
        os.close(inner)


def _drain(terminal: int, seconds: float) -> int:
    """Read what the screen draws for a time, as a terminal does; returns its bytes."""
    until, found = time.monotonic() + seconds, 0
    while (left := until - time.monotonic()) > 0:
        if select.select([terminal], [], [], left)[0]:
            found += len(os.read(terminal, 1 << 16))
    return found


def processor_seconds(pid: int) -> float:
    """Return the processor time [s] that a process has used (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _load(pid: int, terminal: int, seconds: float) -> tuple[float, int]:
    """Return (processor share [% of one core], bytes a second) of the screen."""
    before, began = processor_seconds(pid), time.monotonic()
    drawn = _drain(terminal, seconds)
    spent = time.monotonic() - began
    return 100.0 * (processor_seconds(pid) - before) / spent, round(drawn / spent)


def screen_figures(say: Callable[[str], None], seconds: float) -> list[Figure]:
    """Measure the screen on a live run of 17 channels at 1 kHz, and after its end."""
    columns, rows = SIZE
    say(f"screen: {columns} x {rows}, 17 channels at 1 kHz, {seconds:g} s live and idle")
    # A socket's address holds about 100 bytes: the folder's name must be short.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        script = f"from rig.cli.bench.screen_figures import publish; publish({WARM + seconds + 1})"
        environment = {**os.environ, "XDG_RUNTIME_DIR": folder}
        run = subprocess.Popen([sys.executable, "-c", script], env=environment)
        try:
            with _screen(folder) as (pid, terminal):
                _drain(terminal, WARM)
                live, drawn = _load(pid, terminal, seconds)
                while run.poll() is None:
                    _drain(terminal, 0.1)
                _drain(terminal, SETTLE)
                idle, silent = _load(pid, terminal, seconds)
        finally:
            run.kill()
            run.wait()
    return [
        Figure("screen", "live, of one core", live, "%", LIVE_LIMIT),
        Figure("screen", "live, to the terminal", drawn / 1e3, "kB/s"),
        Figure("screen", "run ended, of one core", idle, "%", IDLE_LIMIT),
        Figure("screen", "run ended, to the terminal", silent / 1e3, "kB/s", 0.0),
    ]
