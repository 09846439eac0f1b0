"""The `simulate` verb: a run simulated by a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.errors import WorkError

if TYPE_CHECKING:
    from analysis.simulation.model import Model
    from rig.model.records import Record
    from rig.model.rig import Rig

RunArgument = Annotated[Path, typer.Argument(help="A run folder.")]


def simulate(
    model: Annotated[Path, typer.Argument(help="A model file of `identify` or `trace`.")],
    run: RunArgument,
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
) -> None:
    """Simulate a run with a model driven by the measured spool signals.

    Pistons and chamber pressures of the excited joints are simulated from the record's first
    state; the other channels are the measured ones.

    Example: bramah simulate model.json runs/monday --out runs/monday-simulated
    """
    from rig.runs.archive import write_run
    from rig.runs.store import load_run, refuse_occupied

    refuse_occupied(out)
    loaded = load_run(run)
    simulated = channel_simulator(model, loaded.rig, str(run))
    records = tuple(replace(r, channels={**r.channels, **simulated(r)}) for r in loaded.records)
    source = f"{run.name} simulated by {model.name}"
    typer.echo(str(write_run(out, replace(loaded, records=records, source=source))))


def channel_simulator(path: Path, rig: Rig, source: str) -> Callable[[Record], Mapping[str, Any]]:
    """Return a function that simulates a record's excited joints: channels (n,) by name.

    Raises InputError for a model of another rig, WorkError if a simulation fails.
    """
    from analysis.signals.conditioning import sampled_channels
    from analysis.simulation.model import load_model, refuse_other_rig
    from analysis.simulation.validate import validate_record

    model: Model = load_model(path)
    refuse_other_rig(model, rig, source)

    def channels(record: Record) -> Mapping[str, Any]:
        result = validate_record(model, rig, record)
        if result.failure:
            raise WorkError(f"record {record.name!r}: {path} cannot be simulated: {result.failure}")
        all_channels = result.simulation.channels()
        simulated = {name: all_channels[name] for name in result.measured}
        return sampled_channels(rig, record.sample_rate, simulated)

    return channels
