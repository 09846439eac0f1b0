"""Verbs that hand records on: `export` to other programs, `simulate` as a model has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.errors import WorkError
from rig.cli.output import progress

if TYPE_CHECKING:
    from analysis.simulation.model import Model
    from rig.model.records import Record
    from rig.model.rig import Rig

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
    more = None if model is None else _simulator(model, read_run_head(run).rig, str(run))
    folder = run if run.name not in ("", "..") else run.resolve()
    wanted = folder.with_name(f"{folder.name}-{kind}") if out is None else out
    files = export_run(run, wanted, kind, more)
    progress(f"{len(files)} files")
    typer.echo(str(wanted))


def simulate(
    model: Annotated[Path, typer.Argument(help="A model file of `identify` or `trace`.")],
    run: RunArgument,
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
) -> None:
    """Write the run that the model would have given: the measured spool drives it.

    Pistons and chamber pressures of the excited joints are simulated from the record's first
    state; the other channels are the measured ones.

    Example: bramah simulate model.json runs/monday --out runs/monday-simulated
    """
    from rig.runs.exchange.fixtures import write_run
    from rig.runs.store import load_run, refuse_occupied

    refuse_occupied(out)
    loaded = load_run(run)
    simulated = _simulator(model, loaded.rig, str(run))
    records = tuple(replace(r, channels={**r.channels, **simulated(r)}) for r in loaded.records)
    source = f"{run.name} simulated by {model.name}"
    typer.echo(str(write_run(out, replace(loaded, records=records, source=source))))


def _simulator(path: Path, rig: Rig, source: str) -> Callable[[Record], Mapping[str, Any]]:
    """Return what simulates a record's excited joints: channels (n,) by name.

    Raises InputError for a model of another rig, WorkError where a simulation fails.
    """
    from analysis.simulation.model import load_model, refuse_other_rig
    from analysis.simulation.validate import validate_record

    model: Model = load_model(path)
    refuse_other_rig(model, rig, source)

    def channels(record: Record) -> Mapping[str, Any]:
        result = validate_record(model, rig, record)
        if result.failure:
            raise WorkError(f"record {record.name!r}: {path} cannot be simulated: {result.failure}")
        every = result.simulation.channels()
        return {name: every[name] for name in result.measured}

    return channels


def register(app: typer.Typer) -> None:
    """Add these verbs to the command line."""
    app.command()(export)
    app.command()(simulate)
