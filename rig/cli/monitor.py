"""The `monitor` verb: the operator's screen."""

from __future__ import annotations

from typing import Annotated

import typer


def monitor(
    rig: Annotated[str | None, typer.Option("--rig", help="Only runs of this rig.")] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="One line a second, for screen readers and logs.")
    ] = False,
) -> None:
    """Watch and command a running protocol; space stops it, q leaves it running.

    Example: bramah monitor --rig shinshu-2dof
    """
    if plain:
        from rig.tui.plain import read_aloud

        read_aloud(rig, typer.echo)
        return
    from rig.tui.app import main

    raise typer.Exit(main(rig))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(monitor)
