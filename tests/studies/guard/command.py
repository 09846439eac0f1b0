"""The study `guard`: false alarms over shipped rigs, protocols and effects."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json


def guard(
    only: Annotated[str, typer.Option(help="Cases whose name contains this.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated benches.")] = 3,
    json: JsonOption = None,
) -> None:
    """Count the alarms of sound and aged benches under every shipped protocol: there are none.

    Example: python -m tests.studies guard --only validate
    """
    from tests.studies.guard.grid import alarms, cases

    found = []
    for case in cases():
        if only not in case.name:
            continue
        raised, end = alarms(case, seed)
        found.append({"case": case.name, "alarms": raised, "end": end})
        progress(f"{case.name}: {', '.join(raised) or 'calm'}{f' ({end})' if end else ''}")
    write_json(json, found)
    wrong = sum(bool(one["alarms"]) for one in found)
    typer.echo(f"{len(found)} runs, {wrong} with an alarm, {sum(bool(f['end']) for f in found)} "
               "that did not complete")  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add this study to the command line."""
    app.command()(guard)
