"""The `sim` verb: the simulated bench as a separate process."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import RigOption, writable_file


def sim(
    rig: RigOption,
    wire: Annotated[
        str,
        typer.Option(
            help="modbus-tcp, modbus-rtu or serial (on a pseudo-terminal), can (by socketcand), "
            "can-slcan (on a pseudo-terminal), or canopen-408 (by socketcand, in real time)."
        ),
    ] = "modbus-tcp",
    scenario: Annotated[
        str | None,
        typer.Option(help="Hidden effects: a file, worn-seal, or random (drawn by the seed)."),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of noise, temperature and random scenarios.", min=0)
    ] = 0,
    wire_faults: Annotated[
        str | None,
        typer.Option(
            help="Faults of the wire: a file, or a name such as frame_lost (1 % of all frames)."
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(help="TCP port; 0 takes a free one.  [default: the rig's]", min=0, max=65535),
    ] = None,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run in real time.")] = False,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Write true parameters and hidden effects to this JSON file.",
            callback=writable_file,
        ),
    ] = None,
    parent: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Run the simulated bench as a process; it prints its endpoint on the first line.

    Example: bramah sim --rig shinshu-2dof --wire modbus-tcp --seed 1
    """
    # pymodbus's server loads aiohttp, if installed, for a web page that is not used here; without
    # it the bench starts in three quarters of the time.
    if "aiohttp" not in sys.modules:
        sys.modules["aiohttp"] = None  # type: ignore[assignment]
    from rig.cli.simulated.simulator import serve_bench

    serve_bench(rig, wire, seed, scenario, wire_faults, port, real_time, truth, parent)
