"""The trace's report with what only the command line knows."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from analysis.report import Provenance
from analysis.trace.report import write_trace_report
from analysis.trace.result import Trace
from rig.model.records import Run
from rig.services.versions import versions


def write_trace(path: Path, holdout: Sequence[Run], result: Trace) -> None:
    """Write the trace's report."""
    line = shlex.join(["bramah", *sys.argv[1:]])
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")
    write_trace_report(
        path, holdout, result, Provenance(date=date, commands=(line,), versions=versions())
    )
