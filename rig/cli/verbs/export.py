"""The `export` verb: a run written for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.errors import WorkError
from rig.cli.text.output import progress
from rig.cli.verbs.simulate import RunArgument, channel_simulator

if TYPE_CHECKING:
    from analysis.simulation.model import Model

UNITS: Final = "fmu"
CRATE: Final = "ro-crate"
ModelOption = Annotated[
    Path | None,
    typer.Option(
        help="A model file: adds its simulated channels beside the measured ones; with fmu, the "
        "model to write [default: identified from the run]."
    ),
]


def export(
    run: RunArgument,
    kind: Annotated[
        str, typer.Option("--format", help="csv, mat, parquet, mf4, fmu or ro-crate.")
    ] = "csv",
    out: Annotated[
        Path | None, typer.Option(help="The folder to make.  [default: RUN-FORMAT beside the run]")
    ] = None,
    model: ModelOption = None,
    licence: Annotated[
        str, typer.Option("--license", help="URL of the data's licence, for ro-crate.")
    ] = "",
) -> None:
    """Write a run for other programs, one file per record; csv and mat can be imported again.

    `--format fmu` writes the identified model with its effects instead, as functional mock-up
    units (FMI 2 and 3, co-simulation, for 64-bit Linux and Windows); ro-crate contains the run's
    files and a description for archives and repositories.

    Example: bramah export runs/monday --format mat
    """
    from rig.model.parse import InputError
    from rig.runs.exchange.export import WRITERS, export_run, library_missing
    from rig.runs.stream import read_run_head

    folder = run if run.name not in ("", "..") else run.resolve()
    target = folder.with_name(f"{folder.name}-{kind}") if out is None else out
    if kind == UNITS:
        typer.echo(str(_write_units(run, target, model)))
        return
    if kind not in (*WRITERS, CRATE):
        raise InputError(f"--format {kind}: expected one of: {' '.join((*WRITERS, UNITS, CRATE))}")
    missing = library_missing(kind)
    if missing:
        raise WorkError(
            f"--format {kind} needs the package {missing}, which is not installed: "
            "pip install 'bramah[export]'"
        )
    if kind == CRATE:
        if model is not None:
            raise InputError(
                "--model cannot be used with --format ro-crate, which contains the run unchanged"
            )
        from rig.runs.exchange.ro_crate import export_crate

        progress(f"{len(export_crate(run, target, licence))} files")
        typer.echo(str(target))
        return
    extra = None if model is None else channel_simulator(model, read_run_head(run).rig, str(run))
    files = export_run(run, target, kind, extra)
    progress(f"{len(files)} files")
    unfinished = [
        r for r in read_run_head(run, partial=True).records if not r.attributes["complete"]
    ]
    if unfinished:
        names = " ".join(record.name for record in unfinished)
        progress(f"left out, not recorded to the end: {names} (--format ro-crate contains them)")
    typer.echo(str(target))


def _write_units(run: Path, out: Path, path: Path | None) -> Path:
    """Write the model's mock-up units into `out`; return the folder."""
    from analysis.simulation.fmu.archive import (
        TARGETS,
        CompilationError,
        compiler_missing,
        write_fmus,
    )
    from rig.runs.files import new_folder
    from rig.runs.store import refuse_occupied

    if compiler_missing():
        raise WorkError(
            "--format fmu needs the package ziglang, a C compiler, which is not installed: "
            "pip install 'bramah[fmu]'"
        )
    refuse_occupied(out)
    model = _model_of(run, path)
    source = run.name if path is None else path.name
    description = f"{model.rig.name}, identified: {source}"
    progress("Linux and Windows, FMI 2 and 3: about a minute the first time")
    try:
        with new_folder(out) as folder:
            files = write_fmus(model, folder, model.rig.name, description, TARGETS, progress)
    except CompilationError as error:
        raise WorkError(str(error)) from error
    progress(" ".join(file.name for file in files))
    return out


def _model_of(run: Path, path: Path | None) -> Model:
    """Return the model of a file for this run's rig, or the one identified from the run."""
    from analysis.identify.identify import identify
    from analysis.simulation.model import load_model, refuse_other_rig
    from rig.runs.store import load_run
    from rig.runs.stream import read_run_head

    if path is None:
        return identify([load_run(run)]).model
    model = load_model(path)
    refuse_other_rig(model, read_run_head(run).rig, str(run))
    return model
