"""The `recover` verb: an interrupted run finalised from its journal."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.errors import WorkError


def recover(
    run: Annotated[Path, typer.Argument(help="The run folder of an interrupted run.")],
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Also finalise a run that another computer may still be writing."
        ),
    ] = False,
) -> None:
    """Finalise an interrupted run from its journal, so that its records can be read.

    Example: bramah recover runs/monday
    """
    from rig.runs.recover import recover as recover_run

    report = recover_run(run, force=force)
    typer.echo(report.message)
    if report.damaged is not None:
        lost = f"{report.missing} samples are lost" if report.missing else "no loss is known"
        raise WorkError(f"{run}: its journal was damaged: {lost}; {report.damaged.name} is kept")
