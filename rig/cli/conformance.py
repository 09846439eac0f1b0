"""The `conformance` verb: what every driver must do, tried on a device that is there."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.device import reached_at
from rig.cli.options import EndpointOption, JsonOption, RigOption
from rig.cli.output import progress, table, write_json


def conformance(
    driver: Annotated[str, typer.Argument(help="The kind of wire, such as modbus-tcp.")],
    rig: RigOption = "shinshu-2dof",
    endpoint: EndpointOption = None,
    outputs: Annotated[
        bool, typer.Option("--outputs", help="Also make the checks that put out voltages.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only this check; repeatable.")] = None,
    json: JsonOption = None,
) -> None:
    """Check a device and its driver; nothing is put out without --outputs; exit 1 on a failure.

    Example: bramah conformance modbus-tcp --endpoint modbus-tcp://127.0.0.1:5020
    """
    from drivers.conformance import CheckVerdict, live_subject, run
    from rig.cli.errors import WorkError
    from rig.model.parse import InputError
    from rig.runs.rigs import load_bench

    described = reached_at(load_bench(rig), endpoint)
    if described.wire.kind != driver:
        raise InputError(
            f"{driver}: rig {described.name!r} is reached by {described.wire.kind}; "
            f"name that, or give --endpoint {driver}://..."
        )
    subject = live_subject(described)
    if outputs:
        progress(f"the outputs will reach {subject.volts:g} V and what they drive will move")
    try:
        report = run(subject, only=only or (), outputs=outputs)
    except ValueError as error:
        raise InputError(f"--only: {error}") from error
    write_json(json, asdict(report))
    if json != Path("-"):
        rows = [(result.check, result.verdict.value, result.reason) for result in report.results]
        typer.echo(table(("check", "verdict", "why"), rows))
    failed = [failure.check for failure in report.of(CheckVerdict.FAILED)]
    if failed:
        raise WorkError(f"{driver} fails {len(failed)} checks: {', '.join(failed)}")
