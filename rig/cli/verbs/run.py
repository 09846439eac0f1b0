"""The `run` verb: a protocol run unattended into a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli import options as opt
from rig.cli.text.output import progress


def _above_zero(param: typer.CallbackParam, value: float) -> float:
    if not value > 0.0:
        from rig.model.parse import InputError

        raise InputError(f"{param.opts[0]} {value:g}: expected more than 0 s")
    return value


def run(
    protocol: opt.ProtocolArgument,
    rig: opt.RigOption,
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
    endpoint: opt.EndpointOption = None,
    repeats: opt.RepeatsOption = None,
    duration: opt.DurationOption = None,
    amplitude_scale: opt.ScaleOption = 1.0,
    wave_seed: opt.WaveSeedOption = None,
    step: opt.StepOption = None,
    set_: opt.SetOption = None,
    operator: Annotated[
        str | None,
        typer.Option(help="Name written into the run.  [default: the user]", callback=opt.one_line),
    ] = None,
    model: opt.ModelOption = None,
    nominal: opt.NominalOption = False,
    track: Annotated[
        bool, typer.Option("--track", help="Estimate b and the flow gains during the run.")
    ] = False,
    memory: Annotated[
        float, typer.Option(help="Forgetting time constant of --track [s].", callback=_above_zero)
    ] = float("inf"),
    attended: Annotated[
        bool | None,
        typer.Option(
            "--attended/--unattended",
            help="Whether a person answers prompts.  [default: yes at a terminal]",
        ),
    ] = None,
) -> None:
    """Run a protocol unattended into a run folder; Ctrl-C zeroes the outputs and keeps the data.

    Example: bramah run lock-and-excite-multisine --rig shinshu-2dof --out runs/monday
    """
    from rig.cli.execution.protocol_run import ProtocolJob, run_protocol

    changes = opt.overridden(repeats, duration, amplitude_scale, wave_seed, step, set_)
    job = ProtocolJob(
        protocol, rig, out, endpoint, changes, operator, track, memory, attended, model, nominal
    )
    folder = run_protocol(job, progress)
    typer.echo(str(folder))
