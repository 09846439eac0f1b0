"""The `dbc` verb: the DBC file of a rig on a CAN bus."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.options import RigOption


def dbc(
    rig: RigOption, fd: Annotated[bool, typer.Option("--fd", help="Use CAN FD frames.")] = False
) -> None:
    """Print the DBC file of a rig: the messages of its bench on a CAN bus.

    Example: bramah dbc --rig shinshu-2dof
    """
    from rig.model.wire.can_database import database_text
    from rig.runs.rigs import load_bench

    typer.echo(database_text(load_bench(rig), fd=fd), nl=False)
