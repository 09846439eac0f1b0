"""`python -m tests.studies wires`: the same parameters over every wire, and long streams."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final

import typer

from rig.cli.errors import WorkError
from rig.cli.text.output import progress
from tests.studies.pages import markdown_table, replace_section
from tests.studies.wires import agreement, endurance

PAGE: Final = "wires.md"


def wires(
    docs: Annotated[
        Path | None, typer.Option(help="Also put the tables into wires.md of this folder.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated benches.")] = 1,
    minutes: Annotated[
        float, typer.Option(min=0.0, help="Of streaming over each wire in real time; 0: none.")
    ] = 0.0,
    wire: Annotated[
        list[str] | None, typer.Option(help="Stream over this wire only; may be repeated.")
    ] = None,
    same: Annotated[bool, typer.Option(help="Identify over every wire and compare.")] = True,
) -> None:
    """Identify the same parameters over every wire; with --minutes also stream for so long.

    Rows of wires that were not streamed over stay in the page as they are.

    Example: python -m tests.studies wires --minutes 10 --docs docs
    """
    parts, apart = {}, ""
    streamed = endurance.chosen(wire or ())
    if same:
        with TemporaryDirectory(prefix="bramah-wires-") as folder:
            results = agreement.every_wire(Path(folder), seed, progress)
        parts["same parameters"] = "\n".join(
            markdown_table(agreement.HEADER, agreement.agreement_rows(results))
        )
        for result in results[1:]:
            name, share = result.apart(results[0])
            if share > 1.0 or len(result.parameters) < len(results[0].parameters):
                apart = f"{result.wire}: {name} lies {share:.2f} of both intervals from Modbus TCP"
    if minutes:
        rows = endurance.rows(streamed, minutes, progress)
        if docs is not None:
            rows = endurance.with_rows_of(docs / PAGE, rows)
        parts[endurance.SECTION] = "\n".join(markdown_table(endurance.HEADER, rows))
    for name, part in parts.items():
        typer.echo(part)
        if docs is not None:
            replace_section(docs / PAGE, name, part)
    if apart:
        raise WorkError(apart)


def register(app: typer.Typer) -> None:
    """Add this study to `python -m tests.studies`."""
    app.command()(wires)
