"""Verbs of the bench: sim, check, run, monitor, runs, recover."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.output import progress, table, write_json

log = logging.getLogger(__name__)

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
    str | None, typer.Option(help="modbus-tcp://HOST:PORT instead of the rig's wire.")
]
JsonOption = Annotated[
    Path | None,
    typer.Option("--json", help="Write the machine-readable result here; - is standard output."),
]


def sim(
    rig: RigOption,
    wire: Annotated[
        str, typer.Option(help="modbus-tcp or modbus-rtu (on a pseudo-terminal).")
    ] = "modbus-tcp",
    scenario: Annotated[
        str | None,
        typer.Option(help="A file of hidden effects, worn-seal, or random: drawn by the seed."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of noise, temperature, and what is drawn.", min=0)] = 0,
    port: Annotated[
        int | None, typer.Option(help="0 takes a free one.  [default: the rig's]", min=0, max=65535)
    ] = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Keep pace with the clock on the wall.")
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(help="Write true parameters and what is hidden to this JSON file."),
    ] = None,
    parent: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Run the simulated bench as a process of its own; its endpoint is the first line printed.

    Example: bramah sim --rig shinshu-2dof --wire modbus-tcp --seed 1
    """
    from rig.cli.simulator import Served, serve_bench

    serve_bench(Served(rig, seed, scenario, port, real_time, truth, parent, wire))


def check(
    protocol: Annotated[str, typer.Argument(help="A shipped protocol's name, or a file.")],
    rig: RigOption,
    repeats: RepeatsOption = None,
    duration: DurationOption = None,
    amplitude_scale: ScaleOption = 1.0,
    wave_seed: WaveSeedOption = None,
    step: StepOption = None,
    json: JsonOption = None,
) -> None:
    """Prove a protocol against the limits on the twin and predict its errors; nothing moves.

    Example: bramah check lock-and-excite --rig shinshu-2dof
    """
    from rig.cli.foresight import as_dict, foresee, prediction_text
    from rig.cli.running import overridden
    from rig.cli.sheets import check_text

    found = foresee(protocol, rig, overridden(repeats, duration, amplitude_scale, wave_seed, step))
    write_json(json, as_dict(found))
    if json != Path("-"):
        typer.echo(f"{check_text(found.limits)}\n\n{prediction_text(found)}")
    found.limits.require()


def run(
    protocol: Annotated[str, typer.Argument(help="A shipped protocol's name, or a file.")],
    rig: RigOption,
    out: Annotated[Path, typer.Option(help="The run folder to make.")],
    endpoint: EndpointOption = None,
    repeats: RepeatsOption = None,
    duration: DurationOption = None,
    amplitude_scale: ScaleOption = 1.0,
    wave_seed: WaveSeedOption = None,
    step: StepOption = None,
    operator: Annotated[
        str | None, typer.Option(help="Written into the run.  [default: you]")
    ] = None,
    track: Annotated[
        bool, typer.Option("--track", help="Follow b and the flow gains while it runs.")
    ] = False,
    memory: Annotated[
        float, typer.Option(help="Of --track: forget with this time constant [s].")
    ] = float("inf"),
) -> None:
    """Run a protocol unattended into a run folder; Ctrl-C zeroes the outputs and keeps the data.

    Example: bramah run lock-and-excite-multisine --rig shinshu-2dof --out runs/monday
    """
    from rig.cli.running import ProtocolJob, overridden, run_protocol

    changes = overridden(repeats, duration, amplitude_scale, wave_seed, step)
    job = ProtocolJob(protocol, rig, out, endpoint, changes, operator, track, memory)
    folder = run_protocol(job, progress)
    typer.echo(str(folder))


def reset(
    rig: RigOption,
    endpoint: EndpointOption = None,
    reason: Annotated[
        str, typer.Option(help="What was found and done; kept with the trip.  [required]")
    ] = "",
) -> None:
    """Clear a latched trip, in the device and on this computer, after a look at the bench.

    Example: bramah reset --rig shinshu-2dof --reason "pressure sensor 2 replaced"
    """
    from rig.cli.running import reset_device

    typer.echo(f"cleared: {reset_device(rig, endpoint, reason)}")


def monitor(
    rig: Annotated[str | None, typer.Option("--rig", help="Only runs of this rig.")] = None,
) -> None:
    """Watch a running protocol: pressures, limits, pistons; s stops it, q leaves it running.

    Example: bramah monitor --rig shinshu-2dof
    """
    from rig.tui.app import main

    raise typer.Exit(main(rig))


def runs(
    folder: Annotated[Path, typer.Argument(help="A folder that holds run folders.")] = Path(),
    json: JsonOption = None,
) -> None:
    """List runs with their state.

    Example: bramah runs runs/
    """
    from rig.runs.store import list_runs

    found = list_runs(folder)
    write_json(json, [{**asdict(one), "path": str(one.path)} for one in found])
    if json == Path("-"):
        return
    if not found:
        progress(f"no runs in {folder}")
        return
    header = ("run", "state", "rig", "protocol", "created", "records")
    rows = [
        (
            one.path.name,
            one.state,
            one.rig,
            one.protocol,
            one.created[:16],
            str(one.records) if one.records >= 0 else "—",
        )
        for one in found
    ]
    typer.echo(table(header, rows))
    for one in found:
        if one.message:
            typer.echo(f"{one.path.name}: {one.message}")


def recover(
    run: Annotated[Path, typer.Argument(help="The run folder of an interrupted run.")],
    force: Annotated[
        bool, typer.Option("--force", help="Also a run of another computer that looks alive.")
    ] = False,
) -> None:
    """Finalise an interrupted run from its journal; what was recorded becomes readable.

    Example: bramah recover runs/monday
    """
    from rig.runs.recover import recover as recover_run

    typer.echo(recover_run(run, force=force).message)


def register(app: typer.Typer) -> None:
    """Add these verbs to the command line."""
    for verb in (sim, check, run, reset, monitor, runs, recover):
        app.command()(verb)
