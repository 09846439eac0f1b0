"""`python -m tests.studies conformance`: every check, wire and fault of a wire at full effort."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Final

import typer

from drivers.conformance import CheckVerdict, ConformanceReport, RandomCallBudget, Subject, run
from rig.cli.bench.faults.figures import quiet
from rig.cli.errors import WorkError
from rig.cli.text.output import progress, table
from rig.model.parse import InputError
from tests.drivers.can_bench import can_subject
from tests.drivers.conformance_benches import FAULTS, on_wire
from tests.drivers.valve_bus import valves_subject

SUBJECTS: Final[Mapping[str, Callable[[], Subject]]] = {
    **{wire: partial(on_wire, wire) for wire in FAULTS},
    "can, in its adapter": can_subject,
    "canopen-408": valves_subject,
}


def conformance(
    wire: Annotated[list[str] | None, typer.Option(help="Only this wire; may be repeated.")] = None,
    sequences: Annotated[int, typer.Option(min=1, help="Random sequences of calls a wire.")] = 60,
    calls: Annotated[int, typer.Option(min=1, help="Calls of a sequence at most.")] = 30,
) -> None:
    """Run all conformance checks on each shipped driver, its wire spoiled by every fault.

    Example: python -m tests.studies conformance --wire serial
    """
    wanted = wire or list(SUBJECTS)
    for name in wanted:
        if name not in SUBJECTS:
            raise InputError(f"--wire {name}: expected one of: {' '.join(SUBJECTS)}")
    failed = 0
    rows = []
    for name in wanted:
        progress(f"{name}: all checks, {sequences} random sequences of up to {calls} calls")
        began = time.perf_counter()
        subject = SUBJECTS[name]()
        with subject.make() as bench:
            faults = len(bench.faults)
        with quiet():
            report = run(subject, effort=RandomCallBudget(sequences, calls))
        rows.append(_row(report, faults, time.perf_counter() - began))
        failed += len(report.of(CheckVerdict.FAILED))
        for verdict in (CheckVerdict.FAILED, CheckVerdict.SKIPPED):
            for result in report.of(verdict):
                typer.echo(f"{name}: {verdict} {result.check}: {result.reason}")
    typer.echo(table(("wire", "faults", "passed", "failed", "skipped", "seconds"), rows))
    if failed:
        raise WorkError(f"{failed} checks failed; their reasons stand above the table")


def _row(report: ConformanceReport, faults: int, seconds: float) -> tuple[str, ...]:
    verdicts = (CheckVerdict.PASSED, CheckVerdict.FAILED, CheckVerdict.SKIPPED)
    counts = (str(len(report.of(verdict))) for verdict in verdicts)
    return (report.subject, str(faults), *counts, f"{seconds:.0f}")


def register(app: typer.Typer) -> None:
    """Add this study to `python -m tests.studies`."""
    app.command()(conformance)
