"""The command as a user has it, and a simulated bench beside it, each a process of its own.

They are forked from a process that has done their imports (`tests.forked`).

What ends by itself and needs no process runs in this one too (`bramah_here`), without the half
second of imports that each process begins with.
"""

from __future__ import annotations

import io
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from drivers import wire_at
from drivers.modbus_tcp import ModbusTcpDriver
from rig.cli.main import run
from rig.runs.rigs import load_rig
from tests.forked import Forked

START = "from rig.cli.main import run; run()"
ROOT = Path(__file__).parents[2]
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LONG = 120.0  # [s] nothing here takes it; a hang ends in an error that says so

SHORT = """
name: short
description: One joint, two short records
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 0 mm, tolerance: 2 mm}]
    excite:
      - joint: 2
        signal: {kind: sine, frequency: 2 Hz, amplitude: 0.8 V}
        centre: 0 mm
        centring: {mode: open-loop, drift: 4 mm, offset: 6 mm, tries: 6}
    repeats: 2
    duration: 2 s
    warm_up: 2
    ramp: 1 s
    settle: 0.2 s
"""
ENDLESS = SHORT.replace("repeats: 2", "repeats: 400").replace("name: short", "name: endless")


def words(*arguments: object) -> list[str]:
    """The command line that starts `bramah` with these arguments."""
    return [sys.executable, "-c", START, *map(str, arguments)]


def bramah(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `bramah` to its end."""
    return _ended(Forked(arguments, cwd))


def _ended(process: Forked) -> subprocess.CompletedProcess[str]:
    with process:
        said, told = process.communicate(timeout=LONG)
    return subprocess.CompletedProcess(process.args, process.wait(), said, told)


def bramah_here(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `bramah` to its end in this process: the same words, the same exit code."""
    line = [str(word) for word in arguments]
    said, told, code = io.StringIO(), io.StringIO(), 0
    with _as_a_process_begins(), redirect_stdout(said), redirect_stderr(told), chdir(cwd or "."):
        try:
            run(line)
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(line, code, said.getvalue(), told.getvalue())


@contextmanager
def _as_a_process_begins() -> Iterator[None]:
    """Take handlers off the log; restore log, signals and hidden modules afterwards."""
    root = logging.getLogger()
    signals = {number: signal.getsignal(number) for number in ENDING}
    handlers, level, modules = root.handlers, root.level, set(sys.modules)
    root.handlers = []
    try:
        yield
    finally:
        root.handlers, root.level = handlers, level
        for number, handler in signals.items():
            signal.signal(number, handler)
        for name in set(sys.modules) - modules:
            if sys.modules[name] is None:  # a library that the command does without
                del sys.modules[name]


def study(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run `python -m tests.studies` to its end."""
    return _ended(Forked(arguments, ROOT, "tests.studies"))


@contextmanager
def started(*arguments: object) -> Iterator[Forked]:
    """Run `bramah` in the background, killed at the end if it has not ended."""
    with Forked(arguments) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


@contextmanager
def simulated(*more: object, rig: str | Path = "shinshu-2dof") -> Iterator[tuple[str, Forked]]:
    """A simulated bench on a free port: (endpoint, process)."""
    line = ["sim", "--rig", rig, "--port", 0, "--parent", os.getpid(), *more]
    with started(*line) as process:
        yield process.stdout.readline().strip(), process
        process.send_signal(signal.SIGTERM)
        process.wait(LONG)


def wait_for(what: str, process: Forked, seen: Sequence[str] = ()) -> list[str]:
    """Read the process's progress until a line contains `what`; returns all lines so far."""
    lines = list(seen)
    deadline = time.monotonic() + LONG
    while not any(what in line for line in lines):
        line = process.stderr.readline()
        assert line, f"ended before {what!r}: {lines}"
        assert time.monotonic() < deadline, lines
        lines.append(line)
    return lines


def outputs_are_zero(endpoint: str) -> bool:
    """Ask the device itself, over a connection of one's own."""
    rig = load_rig("shinshu-2dof")
    driver = ModbusTcpDriver(wire_at(endpoint, rig.wire), rig)
    try:
        driver.connect()
        driver.start()
        commands = driver.read_block().data[:, -len(rig.joints) :]
        return bool((commands == 0.0).all())
    finally:
        driver.close()
