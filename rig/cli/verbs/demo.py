"""The `demo` verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[
        Path, typer.Option(help="Parent folder; each demo makes a new folder in it.")
    ] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated bench.")] = 0,
    repeats: Annotated[
        int | None, typer.Option(min=1, help="Repeats per step, instead of the protocol's.")
    ] = None,
) -> None:
    """Run the whole loop on a simulated bench: protocol, records, parameters, trace, report.

    Example: bramah demo --out demo-out
    """
    from rig.cli.simulated.experiment import run_demo

    run_demo(out, seed, repeats)
