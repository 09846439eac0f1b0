"""The `export` verb: a run written for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.errors import WorkError
from rig.cli.output import progress
from rig.cli.simulate import channel_simulator

RunArgument = Annotated[Path, typer.Argument(help="A run folder.")]
ModelOption = Annotated[
    Path | None,
    typer.Option(help="A model file: what it simulates stands beside the measured channels."),
]


def export(
    run: RunArgument,
    kind: Annotated[str, typer.Option("--format", help="csv, mat, parquet or mf4.")] = "csv",
    out: Annotated[
        Path | None, typer.Option(help="The folder to make.  [default: RUN-FORMAT beside the run]")
    ] = None,
    model: ModelOption = None,
) -> None:
    """Write a run for other programs, a file per record; csv and mat can be imported again.

    Example: bramah export runs/monday --format mat
    """
    from rig.runs.exchange.export import export_run, library_missing
    from rig.runs.stream import read_run_head

    missing = library_missing(kind)
    if missing:
        raise WorkError(
            f"--format {kind} needs the package {missing}, which is not installed: "
            "pip install 'bramah[export]'"
        )
    more = None if model is None else channel_simulator(model, read_run_head(run).rig, str(run))
    folder = run if run.name not in ("", "..") else run.resolve()
    wanted = folder.with_name(f"{folder.name}-{kind}") if out is None else out
    files = export_run(run, wanted, kind, more)
    progress(f"{len(files)} files")
    typer.echo(str(wanted))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(export)
