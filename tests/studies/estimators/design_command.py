"""The `study design` verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption, RigOption


def design(
    protocols: Annotated[
        list[str], typer.Argument(help="Shipped names or files; of two the gain is shown.")
    ],
    rig: RigOption,
    seeds: Annotated[int, typer.Option(min=1, max=200, help="Simulated benches.")] = 8,
    first: Annotated[int, typer.Option(min=0, help="Seed of the first bench.")] = 100,
    json: JsonOption = None,
) -> None:
    """Compare predicted standard errors with those found on simulated benches.

    Example: python -m tests.studies design lock-and-excite-multisine better.yaml --rig shinshu-2dof
    """
    from rig.cli.text.output import progress, write_json
    from tests.studies.estimators.design import study, study_json, study_text

    found = study(protocols, rig, first, seeds, progress)
    write_json(json, study_json(found))
    if json != Path("-"):
        typer.echo(study_text(found))


def register(app: typer.Typer) -> None:
    """Add this study to the command line."""
    app.command("design")(design)
