"""`bramah study trace`: how often the trace names what is there, and how often what is not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.bench_commands import JsonOption
from rig.cli.output import progress, write_json
from rig.cli.study_command import studies

Workers = Annotated[int, typer.Option(min=1, help="Processes at once.")]


def trace(
    quick: Annotated[bool, typer.Option("--quick", help="A few cases of each kind.")] = False,
    kinds: Annotated[str, typer.Option(help="Of none, single, pair, outside.")] = (
        "none single pair outside"
    ),
    seed: Annotated[int, typer.Option(min=0, help="First seed; below 100 is for tuning.")] = 100,
    count: Annotated[
        int, typer.Option(min=1, help="Cases of each kind, and of each effect alone.")
    ] = 3,
    only: Annotated[str, typer.Option(help="Only these effects alone, by name.")] = "",
    level: Annotated[
        int | None, typer.Option(min=0, max=2, help="Only this size: 0 small .. 2 large.")
    ] = None,
    workers: Workers = 2,
    json: JsonOption = None,
) -> None:
    """Hide effects in simulated benches and count what the trace makes of them.

    Example: bramah study trace --quick
    """
    from rig.cli.study_trace import all_of, cases
    from rig.cli.study_trace_text import as_json, text

    names = tuple(only.split())
    if quick:
        names = names or ("coulomb_friction", "internal_leakage", "valve_deadband", "torque_offset")
        work = cases(tuple(kinds.split()), seed, 2, names, level if level is not None else 2)
    else:
        work = cases(tuple(kinds.split()), seed, count, names, level)
    outcomes = list(all_of(work, workers, progress))
    write_json(json, as_json(outcomes))
    if json != Path("-"):
        typer.echo(text(outcomes))


def register(app: typer.Typer) -> None:
    """Add this verb to the studies."""
    studies.command()(trace)
