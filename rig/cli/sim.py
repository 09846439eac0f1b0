"""The `sim` verb: the simulated bench as a process of its own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import (
    RigOption,
    writable_file,
)


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
        typer.Option(help="A file of hidden effects, worn-seal, or random: drawn by the seed."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of noise, temperature, and what is drawn.", min=0)] = 0,
    wire_faults: Annotated[
        str | None,
        typer.Option(help="Faults of the wire: a file, or a name such as frame_lost (1 % of all)."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="0 takes a free one.  [default: the rig's]", min=0, max=65535)
    ] = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Keep pace with the clock on the wall.")
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Write true parameters and what is hidden to this JSON file.",
            callback=writable_file,
        ),
    ] = None,
    parent: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Run the simulated bench as a process of its own; its endpoint is the first line printed.

    Example: bramah sim --rig shinshu-2dof --wire modbus-tcp --seed 1
    """
    # pymodbus's server would load aiohttp, where it is installed, for a web page of its own; none
    # is served here, and without it the bench starts a quarter sooner.
    if "aiohttp" not in sys.modules:
        sys.modules["aiohttp"] = None  # type: ignore[assignment]
    from rig.cli.simulator import BenchRequest, serve_bench

    serve_bench(
        BenchRequest(rig, seed, scenario, port, real_time, truth, parent, wire, wire_faults)
    )
