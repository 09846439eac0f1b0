"""`python -m tests.studies faults`: every fault of bench and wire in real sessions."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from rig.cli.text.output import progress
from tests.studies.pages import replace_section


def faults(
    docs: Annotated[
        Path | None, typer.Option(help="Also put the tables into faults.md of this folder.")
    ] = None,
    trials: Annotated[
        int, typer.Option(min=0, help="Sessions in virtual time to count; 0 counts none.")
    ] = 500,
    table: Annotated[bool, typer.Option(help="One session in real time for every row.")] = True,
) -> None:
    """What notices each fault, how fast, what the operator reads and what is kept.

    Example: python -m tests.studies faults --docs docs
    """
    from rig.cli.bench.faults.figures import fault_trials
    from tests.studies.faults import page

    parts = {}
    with TemporaryDirectory(prefix="bramah-faults-") as folder:
        if table:
            parts["noticed"] = page.noticed(page.one_of_each(Path(folder), progress))
        if trials:
            parts["counts"] = page.counts(fault_trials(Path(folder), trials, progress))
    for name, part in parts.items():
        typer.echo(part)
        if docs is not None:
            replace_section(docs / "faults.md", name, part)


def register(app: typer.Typer) -> None:
    """Add this study to `python -m tests.studies`."""
    app.command()(faults)
