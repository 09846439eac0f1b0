"""The `reproduce` verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption


def reproduce(
    out: Annotated[Path, typer.Option(help="Each call makes a folder of its own in here.")] = Path(
        "reproduce-out"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated bench and searches.")] = 100,
    quick: Annotated[
        bool, typer.Option("--quick", help="Three repeats and short searches: a minute.")
    ] = False,
    docs: Annotated[
        Path | None, typer.Option(help="Write the page here too, its figures beside it.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Run the paper's sections IV and V on a simulated bench, beside the paper's numbers.

    Example: python -m tests.studies reproduce --seed 100 --docs docs/reproduction.md
    """
    from tests.studies.reproduction.story import write_story

    write_story(out, seed, quick, docs, json)


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(reproduce)
