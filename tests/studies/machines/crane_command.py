"""The `crane` verb: a measured crane boom, told in tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.text.output import progress


def crane(
    folder: Annotated[
        Path, typer.Argument(help="Holds the crane's CSV files of btorjus/Bachelor.")
    ],
) -> None:
    """Say what the model of a measured crane boom lacks, before and after on unseen records.

    Example: python -m tests.studies crane ../shared/data/uia_crane
    """
    from tests.studies.machines.crane import text

    typer.echo(text(folder, progress))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(crane)
