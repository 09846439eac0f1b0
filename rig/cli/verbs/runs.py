"""The `runs` verb: a filtered list of run folders with state and contents."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import JsonOption, time_since
from rig.cli.text.output import progress, table, write_json

if TYPE_CHECKING:
    from rig.runs.listing.summary import RunSummary

Names = list[str] | None


def runs(
    folder: Annotated[Path, typer.Argument(help="A folder that holds run folders.")] = Path(),
    state: Annotated[
        Names, typer.Option("--state", help="State: running, done, aborted, tripped, interrupted.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Begun since 2026-03-01, 2026-03-01T22:00, or 12h, 7d ago.")
    ] = None,
    rig: Annotated[
        Names, typer.Option("--rig", help="Only runs of this rig; * matches any characters.")
    ] = None,
    protocol: Annotated[
        Names,
        typer.Option("--protocol", help="Only runs of this protocol; * matches any characters."),
    ] = None,
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Rebuild the folder's index from the run folders.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """List runs with their state and contents; values of a repeated option are alternatives.

    Example: bramah runs runs/ --state interrupted --since 12h
    """
    from rig.model.parse import InputError
    from rig.runs.listing.index import indexed_runs
    from rig.runs.listing.index import rebuild as rebuild_index
    from rig.runs.listing.summary import UNREADABLE, crates
    from rig.runs.runstate import STATES

    for name in state or ():
        if name not in (*STATES, UNREADABLE):
            raise InputError(f"--state {name}: expected one of: {', '.join((*STATES, UNREADABLE))}")
    begun = time_since(since)
    if rebuild:
        progress(f"{rebuild_index(folder)} runs in the index of {folder}")
    listed = indexed_runs(folder)
    selected = [
        entry
        for entry in listed
        if (not state or entry.state in state)
        and (begun is None or (entry.created and datetime.fromisoformat(entry.created) >= begun))
        and _matches(entry.rig, rig)
        and _matches(entry.protocol, protocol)
    ]
    if copies := crates(folder):
        names = " ".join(copy.name for copy in copies)
        progress(f"not listed, copies of runs as RO-Crates: {names}")
    write_json(json, [{**asdict(entry), "path": str(entry.path)} for entry in selected])
    if json == Path("-"):
        return
    if not selected:
        progress(f"no runs in {folder}" + (f" that fit, of {len(listed)}" if listed else ""))
        return
    header = ("run", "state", "rig", "protocol", "created", "records", "samples", "lost", "min")
    typer.echo(
        table(header, [_row(entry) for entry in selected], left=("state", "rig", "protocol"))
    )
    for summary in selected:
        if summary.message:
            typer.echo(f"{summary.path.name}: {summary.message}")


def _matches(name: str, patterns: Names) -> bool:
    return not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)


def _row(summary: RunSummary) -> tuple[str, ...]:
    state = f"{summary.state}, recovered" if summary.recovered else summary.state
    partial = f" +{summary.partial}" if summary.partial else ""
    return (
        summary.path.name,
        state,
        summary.rig,
        summary.protocol,
        summary.created[:16],
        f"{summary.records}{partial}" if summary.records >= 0 else "—",
        str(summary.samples) if summary.samples >= 0 else "—",
        str(summary.lost_samples) if summary.samples >= 0 else "—",
        f"{summary.seconds / 60.0:.1f}" if summary.seconds >= 0 else "—",
    )
