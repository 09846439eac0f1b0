"""The `emps` verb: the measured positioning system, told in tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def emps(
    file: Annotated[Path, typer.Argument(help="DATA_EMPS.mat of the public benchmark.")],
) -> None:
    """Identify the measured positioning system, model by model and filter by filter.

    Example: python -m tests.studies emps DATA_EMPS.mat
    """
    from tests.studies.machines.emps import text

    typer.echo(text(file))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(emps)
