"""The `import` verb: records of another system imported as a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.text.output import progress


def import_(
    manifest: Annotated[Path, typer.Argument(help="A YAML file that lists CSV or MAT files.")],
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
) -> None:
    """Import records of another system into a run folder.

    Example: bramah import manifest.yaml --out runs/foreign
    """
    from rig.runs.exchange.importer import import_records

    report = import_records(manifest, out)
    for warning in report.warnings:
        progress(f"note: {warning}")
    typer.echo(str(report.path))
