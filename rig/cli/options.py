"""Options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RigOption = Annotated[
    str, typer.Option("--rig", help="A shipped rig's name, or the path of a rig file.")
]
RepeatsOption = Annotated[int | None, typer.Option(min=1, help="Instead of the file's.")]
DurationOption = Annotated[
    float | None, typer.Option(min=0.01, help="Seconds per record, instead of the file's.")
]
ScaleOption = Annotated[float, typer.Option(help="Multiplies every amplitude of the file.")]
WaveSeedOption = Annotated[
    int | None, typer.Option("--wave-seed", min=0, help="Of the multisines' phases.")
]
StepOption = Annotated[list[str] | None, typer.Option("--step", help="Only this step; repeatable.")]
EndpointOption = Annotated[
    str | None, typer.Option(help="KIND://..., such as modbus-tcp://HOST:PORT, not the rig's wire.")
]
JsonOption = Annotated[
    Path | None,
    typer.Option("--json", help="Write the machine-readable result here; - is standard output."),
]
RunsArgument = Annotated[list[Path], typer.Argument(help="Run folders.")]
