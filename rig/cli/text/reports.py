"""Reports with date, command and software versions."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from analysis.identify.result import Identification
from analysis.report.identification.report import Provenance, render_report
from analysis.report.page import write
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
