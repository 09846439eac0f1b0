"""The trace's report with what only the command line knows."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from analysis.report.identification import Provenance
from analysis.report.loop import write_loop_report
from analysis.report.trace import write_trace_report
from analysis.trace.loop_rounds import Round
from analysis.trace.result import Trace
from rig.model.records import Run
from rig.runs.versions import versions


def write_trace(path: Path, holdout: Sequence[Run], result: Trace) -> None:
    """Write the trace's report."""
    write_trace_report(path, holdout, result, _provenance())


def write_story(
    path: Path, train: Sequence[Run], holdout: Sequence[Run], rounds: Sequence[Round], stopped: str
) -> None:
    """Write the report of a whole loop."""
    write_loop_report(path, train, holdout, rounds, stopped, _provenance())


def _provenance() -> Provenance:
    line = shlex.join(["bramah", *sys.argv[1:]])
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")
    return Provenance(date=date, commands=(line,), versions=versions())
