"""The `conformance` verb: tests of a driver on a connected device."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from rig.cli.execution.device import bench_at
from rig.cli.options import EndpointOption, JsonOption, RigOption
from rig.cli.text.output import print_result, progress, table


def conformance(
    driver: Annotated[str, typer.Argument(help="The driver's name, such as modbus-tcp.")],
    rig: RigOption = "shinshu-2dof",
    endpoint: EndpointOption = None,
    outputs: Annotated[
        bool, typer.Option("--outputs", help="Also run the checks that output voltages.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Run only this check; repeatable.")] = None,
    json: JsonOption = None,
) -> None:
    """Test a driver on a device; outputs stay zero without --outputs; exit 1 on a failure.

    Example: bramah conformance modbus-tcp --endpoint modbus-tcp://127.0.0.1:5020
    """
    from drivers.conformance import CheckVerdict, live_subject, run
    from rig.cli.errors import WorkError
    from rig.model.parse import InputError

    described = bench_at(rig, endpoint)
    if described.wire.kind != driver:
        raise InputError(
            f"{driver}: the wire of rig {described.name!r} is {described.wire.kind}; "
            f"expected that driver, or --endpoint {driver}://..."
        )
    subject = live_subject(described)
    if outputs:
        progress(f"the outputs will reach {subject.volts:g} V: the joints will move")
    try:
        report = run(subject, only=only or (), outputs=outputs)
    except ValueError as error:
        raise InputError(f"--only: {error}") from error
    rows = [(result.check, result.verdict.value, result.reason) for result in report.results]
    print_result(json, asdict(report), table(("check", "verdict", "why"), rows))
    failed = [failure.check for failure in report.of(CheckVerdict.FAILED)]
    if failed:
        raise WorkError(f"{driver} fails {len(failed)} checks: {', '.join(failed)}")
