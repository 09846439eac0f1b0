"""The `kills` and `nights` studies' verbs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from rig.cli.errors import WorkError
from rig.cli.options import JsonOption
from rig.cli.text.output import write_json


def kills(
    count: Annotated[int, typer.Option(min=3, help="Runs to kill, over all wires.")] = 102,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    longest: Annotated[
        float, typer.Option(help="Kill up to this long after the start [s].")
    ] = 14.0,
    json: JsonOption = None,
) -> None:
    """Kill runs at random moments over Modbus TCP, RTU and serial; count what is lost.

    Example: python -m tests.studies kills --count 102
    """
    from tests.studies.nights.kills import WIRES, kills_text, study

    with TemporaryDirectory(prefix="bramah-kills-") as folder:
        found = study(count, seed, Path(folder), longest, WIRES)
    write_json(json, [asdict(kill) for kill in found])
    typer.echo(kills_text(found))
    if any(kill.wrong for kill in found):
        raise WorkError("not every kill left what it must")


def nights(
    jobs: Annotated[int, typer.Option(min=10, help="Items of the queue.")] = 200,
    runner_kills: Annotated[int, typer.Option(min=0, help="Of the queue's runner.")] = 40,
    hours: Annotated[float, typer.Option(help="Simulated hours of one unattended run.")] = 8.0,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    json: JsonOption = None,
) -> None:
    """Run a queue with random faults and kills, and a recording of hours; count and measure.

    Example: python -m tests.studies nights --jobs 200 --hours 8
    """
    from tests.studies.nights.endurance import endurance_text, endure
    from tests.studies.nights.faulty_queue import faulty_queue, queue_text

    with TemporaryDirectory(prefix="bramah-nights-") as folder:
        queue = faulty_queue(Path(folder) / "queue", jobs, runner_kills, seed)
        typer.echo(queue_text(queue))
        long = endure(Path(folder) / "long", hours)
        typer.echo(endurance_text(long))
    write_json(json, {"queue": asdict(queue), "endurance": asdict(long)})
    if queue.wrong:
        raise WorkError("not every item ended as it must")


def unattended(
    hours: Annotated[float, typer.Option(min=0.01, help="Of the clock.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    watchdog: Annotated[
        float | None,
        typer.Option(help="Of the device [s]; longer on a busy computer.  [default: the rig's]"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Keep the run here.  [default: a folder that goes]")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Run a protocol in real time for an hour; measure memory, lost samples and disk.

    Example: python -m tests.studies unattended --hours 1
    """
    from tests.studies.nights.unattended import unattended as measure
    from tests.studies.nights.unattended import unattended_text

    with TemporaryDirectory(prefix="bramah-unattended-") as folder:
        found = measure(out or Path(folder), hours, seed, watchdog)
    write_json(json, asdict(found))
    typer.echo(unattended_text(found))
    if found.wrong:
        raise WorkError("the unattended run did not keep what it must")


def register(app: typer.Typer) -> None:
    """Add these studies to the command line."""
    app.command()(kills)
    app.command()(nights)
    app.command()(unattended)
