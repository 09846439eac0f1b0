"""The reference device in C: compiled once, started with the integrator's rig."""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from tests.drivers.wires import ROOT
from tests.hil_sim.integrator import PRESSURE, seed_rig

FIRMWARE = ROOT / "drivers" / "firmware"
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]


def compiler() -> list[str]:
    """The C compiler of the package `ziglang`, else the system's; skips where there is none."""
    if find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc"]
    if (found := shutil.which("cc")) is not None:
        return [found]
    pytest.skip("no C compiler: neither the package ziglang nor `cc` is installed")


def compile_c(*arguments: str) -> None:
    """Compile with every warning an error."""
    # What the package `ziglang` compiles of its own libraries is kept for the next time.
    kept = Path(tempfile.gettempdir()) / f"bramah-zig-{os.getuid()}"
    environment = os.environ | {"ZIG_GLOBAL_CACHE_DIR": str(kept)}
    subprocess.run([*compiler(), *STRICT, *arguments], check=True, env=environment)


@cache
def built() -> Path:
    """Compile the device with its pty; returns the program."""
    folder = Path(tempfile.mkdtemp(prefix="bramah-firmware-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    program = folder / "posix_bench"
    sources = [str(FIRMWARE / name) for name in ("serial_device.c", "posix_bench.c")]
    compile_c("-O1", "-fno-sanitize=all", *sources, "-o", str(program))
    (folder / "bench.txt").write_text(config(seed_rig()), "utf-8")
    return program


def config(rig: Rig) -> str:
    """The description of the integrator's bench that the program reads."""
    piston = rig.sensors.piston
    lines = [
        f"name {rig.name}",
        f"rate {rig.sample_rate:.9g}",
        f"checksum {reg.converter_checksum(rig)}",
    ]
    for index, joint in enumerate(rig.joints):
        place = rig.channels.index(ch.channel(ch.PISTON, index + 1))
        low, high = piston.range
        valve = f"{joint.valve.command_range:.9g} {joint.valve.command_bits}"
        lines.append(f"joint {valve} {place} {low:.9g} {high:.9g} {piston.bits}")
    for name in rig.channels:
        kind, number = ch.kind_of(name)
        sensor = rig.sensors.of(kind)
        low, high = sensor.range
        known = {ch.SPOOL: "spool", ch.PISTON: "piston", ch.TEMPERATURE: "count"}
        joint = 0 if number is None else number - 1
        value = joint if kind in (ch.SPOOL, ch.PISTON) else PRESSURE
        # The integrator shows no supply pressure: its code is that of zero.
        value = 0.0 if kind == ch.SUPPLY else value
        shown = known.get(kind, "constant")
        lines.append(f"channel {shown} {value} {low:.9g} {high:.9g} {sensor.bits}")
    return "\n".join(lines) + "\n"


def firmware_command(mode: str) -> list[str]:
    """Return the command that starts the device; skips where nothing compiles it."""
    program = built()
    return [str(program), str(program.parent / "bench.txt"), mode, str(os.getpid())]
