"""The `runs` verb: run folders with their state."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import (
    JsonOption,
)
from rig.cli.output import progress, table, write_json


def runs(
    folder: Annotated[Path, typer.Argument(help="A folder that holds run folders.")] = Path(),
    json: JsonOption = None,
) -> None:
    """List runs with their state.

    Example: bramah runs runs/
    """
    from rig.runs.store import list_runs

    found = list_runs(folder)
    write_json(json, [{**asdict(one), "path": str(one.path)} for one in found])
    if json == Path("-"):
        return
    if not found:
        progress(f"no runs in {folder}")
        return
    header = ("run", "state", "rig", "protocol", "created", "records")
    rows = [
        (
            one.path.name,
            one.state,
            one.rig,
            one.protocol,
            one.created[:16],
            str(one.records) if one.records >= 0 else "—",
        )
        for one in found
    ]
    typer.echo(table(header, rows))
    for one in found:
        if one.message:
            typer.echo(f"{one.path.name}: {one.message}")


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(runs)
