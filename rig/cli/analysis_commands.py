"""Verbs of the analysis: import, identify, validate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.bench_commands import JsonOption
from rig.cli.output import progress, write_json
from rig.model.parse import InputError
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
    method: Annotated[
        str, typer.Option(help="coupled, sequential, simultaneous, pso or ga.")
    ] = "coupled",
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--with", help="Add an effect to the model: NAME (every joint) or 'NAME@joint 1'."
        ),
    ] = None,
    estimator: Annotated[
        str, typer.Option(help="ls, wls, iv, robust, output-error; auto: ls or iv as checked.")
    ] = "ls",
    bootstrap: Annotated[
        int, typer.Option(min=0, help="Draws of whole repeats for the intervals; 0: by repeat.")
    ] = 0,
    filtering: Annotated[
        str, typer.Option(help="default, moving-average (the paper's) or butterworth.")
    ] = "default",
    json: JsonOption = None,
    model: Annotated[Path | None, typer.Option(help="Write the model file here.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write an HTML report here.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Compare with this file of `bramah sim --truth`.")
    ] = None,
    physical: Annotated[
        bool, typer.Option("--physical", help="Only parameters that real bodies can have.")
    ] = False,
    evaluations: Annotated[
        int, typer.Option(min=4, help="Candidates that pso or ga may simulate.")
    ] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of pso, ga and the bootstrap.")] = 0,
) -> None:
    """Identify every parameter from all records of the runs at once, or as others would.

    Example: bramah identify runs/monday --json parameters.json --model model.json
    """
    import numpy as np

    from analysis.identify import identify as identify_runs
    from analysis.identify import to_json
    from analysis.methods import SearchOptions
    from analysis.model import save_model
    from analysis.rows import FILTERINGS
    from analysis.terms import with_effects
    from analysis.terms.base import Used
    from rig.cli.method_text import method_text
    from rig.cli.tables import identification_text, read_truth

    loaded = _load(runs)
    if filtering not in FILTERINGS:
        raise InputError(f"--filtering {filtering}: expected one of: {' '.join(FILTERINGS)}")
    terms = [Used(term) for term in with_effects(loaded[0].rig, effects)] if effects else None
    result = identify_runs(
        loaded,
        method,
        terms,
        FILTERINGS[filtering],
        estimator=estimator,
        bootstrap=bootstrap,
        rng=np.random.default_rng(seed),
        search=SearchOptions(evaluations=evaluations),
    )
    told, more = to_json(result), method_text(result)
    if physical:
        from rig.cli.physical import make_physical

        result, told, consistent = make_physical(result)
        more += consistent
    if model is not None:
        save_model(result.model, model)
    write_json(json, told)
    if report is not None:
        from rig.cli.reporting import write_identification

        write_identification(report, loaded, result)
    if json != Path("-"):
        known = None if truth is None else read_truth(truth)
        typer.echo(identification_text(result, known) + more)


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
