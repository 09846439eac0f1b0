"""Reports with what only the command line knows: the date, the command, the versions."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from analysis.identify.result import Identification
from analysis.report.identification import Provenance, write_report
from rig.model.records import Run
from rig.runs.versions import versions


def provenance(commands: tuple[str, ...], seeds: dict[str, str | int]) -> Provenance:
    """Return date, commands, software versions and seeds for the foot of a report."""
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")
    return Provenance(date=date, commands=commands, versions=versions(), seeds=seeds)


def write_identification(path: Path, runs: Sequence[Run], result: Identification) -> None:
    """Write the report of an identification alone."""
    line = shlex.join(["bramah", *sys.argv[1:]])
    write_report(
        path,
        runs=runs,
        identification=result,
        title=f"Identification of {result.model.rig.name}",
        provenance=provenance((line,), {}),
    )
