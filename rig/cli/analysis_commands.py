"""Verbs of the analysis: import, identify, validate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.bench_commands import JsonOption
from rig.cli.output import progress, write_json
from rig.model.records import Run

RunsArgument = Annotated[list[Path], typer.Argument(help="Run folders.")]


def import_foreign(
    manifest: Annotated[Path, typer.Argument(help="A YAML file that lists CSV or MAT files.")],
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
) -> None:
    """Bring records of another system into a run folder.

    Example: bramah import manifest.yaml --out runs/foreign
    """
    from rig.services.importer import import_records

    report = import_records(manifest, out)
    for warning in report.warnings:
        progress(f"note: {warning}")
    typer.echo(str(report.path))


def _load(folders: Sequence[Path]) -> list[Run]:
    from rig.services.store import load_run

    return [load_run(folder) for folder in folders]


def identify(
    runs: RunsArgument,
    method: Annotated[str, typer.Option(help="Only coupled for now.")] = "coupled",
    json: JsonOption = None,
    model: Annotated[Path | None, typer.Option(help="Write the model file here.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write an HTML report here.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Compare with this file of `bramah sim --truth`.")
    ] = None,
) -> None:
    """Identify every parameter from all records of the runs at once.

    Example: bramah identify runs/monday --json parameters.json --model model.json
    """
    from analysis.identify import identify as identify_runs
    from analysis.identify import to_json
    from analysis.model import save_model
    from rig.cli.tables import identification_text, read_truth

    loaded = _load(runs)
    result = identify_runs(loaded, method)
    if model is not None:
        save_model(result.model, model)
    write_json(json, to_json(result))
    if report is not None:
        from rig.cli.reporting import write_identification

        write_identification(report, loaded, result)
    if json != Path("-"):
        typer.echo(identification_text(result, None if truth is None else read_truth(truth)))


def validate(
    model: Annotated[Path, typer.Argument(help="A model file of `bramah identify --model`.")],
    runs: RunsArgument,
    json: JsonOption = None,
) -> None:
    """Simulate the model with the measured spool and compare it with records.

    Example: bramah validate model.json runs/tuesday
    """
    from analysis.model import load_model
    from analysis.validate import to_json
    from analysis.validate import validate as validate_model
    from rig.cli.tables import validation_text

    results = validate_model(load_model(model), _load(runs))
    write_json(json, to_json(results))
    if json != Path("-"):
        typer.echo(validation_text(results))


def register(app: typer.Typer) -> None:
    """Add these verbs to the command line."""
    app.command("import")(import_foreign)
    app.command()(identify)
    app.command()(validate)
