"""The `monitor` verb: the operator's screen."""

from __future__ import annotations

from typing import Annotated

import typer


def monitor(
    rig: Annotated[str | None, typer.Option("--rig", help="Only runs of this rig.")] = None,
) -> None:
    """Watch a running protocol: pressures, limits, pistons; s stops it, q leaves it running.

    Example: bramah monitor --rig shinshu-2dof
    """
    from rig.tui.app import main

    raise typer.Exit(main(rig))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(monitor)
