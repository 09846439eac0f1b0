"""The `pendulum` verb: the chain's mechanics on a measured double pendulum."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json


def pendulum(
    folder: Annotated[
        Path, typer.Argument(help="Holds the two MATLAB files of dynamicslab/MultiArm-Pendulum.")
    ],
    json: JsonOption = None,
) -> None:
    """Identify a measured double pendulum and simulate its segments, beside its authors' figures.

    Example: python -m tests.studies pendulum ../shared/data/multiarm_pendulum
    """
    from tests.studies.machines.pendulum import compare, compared_json, compared_text, read_pendulum

    found = compare(read_pendulum(folder), progress)
    write_json(json, compared_json(found))
    if json != Path("-"):
        typer.echo(compared_text(found))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(pendulum)
