"""Reports with date, command and software versions."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from analysis.identify.result import Identification
from analysis.report import loop, trace
from analysis.report.identification.report import Provenance, render_report
from analysis.report.page import write
from analysis.trace.loop_rounds import Round
from analysis.trace.result import Trace
from rig.model.records import Run
from rig.runs.store import versions


def provenance(
    command: str | None = None, seeds: Mapping[str, str | int] | None = None
) -> Provenance:
    """Return date, command (default: of this process), software versions and seeds."""
    line = shlex.join(["bramah", *sys.argv[1:]]) if command is None else command
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")
    return Provenance(date=date, commands=(line,), versions=versions(), seeds=dict(seeds or {}))


def write_identification(path: Path, runs: Sequence[Run], result: Identification) -> None:
    """Write the report of an identification."""
    text = render_report(
        runs=runs,
        identification=result,
        title=f"Identification of {result.model.rig.name}",
        provenance=provenance(),
    )
    write(path, text)


def write_trace(path: Path, holdout: Sequence[Run], result: Trace) -> None:
    """Write the report of a trace."""
    write(path, trace.render(holdout, result, provenance()))


def write_loop(
    path: Path, train: Sequence[Run], holdout: Sequence[Run], rounds: Sequence[Round], stopped: str
) -> None:
    """Write the report of a loop."""
    write(path, loop.render(train, holdout, rounds, stopped, provenance()))
