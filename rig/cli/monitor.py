"""The `monitor` verb: the operator's screen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import EndpointOption


def monitor(
    rig: Annotated[str | None, typer.Option("--rig", help="Only runs of this rig.")] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="One line a second, for screen readers and logs.")
    ] = False,
    runs: Annotated[
        Path,
        typer.Option("--runs", help="Where runs are listed, and new ones go."),
    ] = Path(),
    endpoint: EndpointOption = None,
) -> None:
    """Watch, start and command a protocol; space stops it, q leaves it running.

    Example: bramah monitor --rig shinshu-2dof
    """
    from rig.runs.rigs import load_rig, shipped_rigs

    # Sessions are known by the rig's name, whatever its file is called.
    is_file = rig is not None and rig not in shipped_rigs() and Path(rig).is_file()
    name = load_rig(rig).name if rig is not None and is_file else rig
    if plain:
        from rig.tui.plain import read_aloud

        read_aloud(name, typer.echo)
        return
    from rig.tui.app import main
    from rig.tui.browse import Browsed

    raise typer.Exit(main(name, Browsed(folder=runs, rig=rig or "", endpoint=endpoint)))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(monitor)
