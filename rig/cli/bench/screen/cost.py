"""Processor time of the operator's screen during a run and after it has ended."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from drivers.base import SampleBlock
from rig.bench.guard import EXCITED, FREE
from rig.bench.screens.display import Display
from rig.bench.screens.sockets import Publisher
from rig.cli.bench.figure import Figure
from rig.cli.bench.screen.terminal import SESSIONS, SIZE, Screen
from rig.model import channels as ch
from rig.runs.rigs import load_rig

RIG: Final = "digger-3dof"  # three joints: 17 channels
WARM: Final = 4.0  # until the screen has started and its caches are filled [s]
SETTLE: Final = 3.0  # until the screen shows that the run has ended [s]
BLOCK: Final = 0.01  # length of a published block [s]
LIVE_LIMIT: Final = 15.0  # [% of one core]
IDLE_LIMIT: Final = 1.0  # [% of one core]


def publish(seconds: float, folder: str) -> None:
    """Publish a synthetic run of 17 channels at 1 kHz to screens, in real time, then end it."""
    rig = load_rig(RIG)
    publisher = Publisher(rig.name, Path(folder))
    display = Display(rig, publisher, "", time.monotonic)
    roles = (EXCITED, *[FREE] * (len(rig.joints) - 1))
    count = round(BLOCK * rig.sample_rate)
    saturated = np.zeros((count, len(rig.channels)), dtype=bool)
    level = {"Pa": (3e6, 1e6), "m": (0.0, 5e-3), "V": (0.0, 0.5), "degC": (40.0, 0.1)}
    base, swing = np.array([level[ch.unit_of(name)] for name in rig.recorded]).T
    phase = np.arange(len(rig.recorded))
    start = time.monotonic()
    for k in range(round(seconds / BLOCK)):
        ticks = k * count + np.arange(count)
        wave = np.sin(2 * np.pi * ticks[:, None] / rig.sample_rate + phase)
        display.commands()
        block = SampleBlock(k, k * count, base + swing * wave, saturated, 0, False)
        display.show(block, 0.001, 0, roles)
        time.sleep(max(start + (k + 1) * BLOCK - time.monotonic(), 0.0))
    display.ended("done", "")
    display.close()


def _load(screen: Screen, seconds: float) -> tuple[float, float]:
    """Return (processor share [% of one core], bytes a second) of the screen."""
    before, start = screen.processor_seconds(), time.monotonic()
    time.sleep(seconds)
    spent = time.monotonic() - start
    share = 100.0 * (screen.processor_seconds() - before) / spent
    return share, screen.bytes_since(start) / spent


def cost_figures(runtime: Path, say: Callable[[str], None], seconds: float) -> list[Figure]:
    """Measure the screen on a live run of 17 channels at 1 kHz, and after its end."""
    columns, rows = SIZE
    say(f"screen: {columns} x {rows}, 17 channels at 1 kHz, {seconds:g} s live and idle")
    words = f"{WARM + seconds + 1}, {str(runtime / SESSIONS)!r}"
    script = f"from rig.cli.bench.screen.cost import publish; publish({words})"
    with subprocess.Popen([sys.executable, "-c", script]) as run, Screen(runtime) as screen:
        try:
            time.sleep(WARM)
            live, drawn = _load(screen, seconds)
            run.wait()
            time.sleep(SETTLE)
            idle, silent = _load(screen, seconds)
        finally:
            run.kill()
    return [
        Figure("screen", "live, of one core", live, "%", LIVE_LIMIT),
        Figure("screen", "live, to the terminal", drawn / 1e3, "kB/s"),
        Figure("screen", "run ended, of one core", idle, "%", IDLE_LIMIT),
        Figure("screen", "run ended, to the terminal", silent / 1e3, "kB/s", 0.0),
    ]
