"""The `manual` verb: a session in which a screen moves one joint at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import EndpointOption, RigOption
from rig.cli.text.output import progress


def manual(
    rig: RigOption,
    endpoint: EndpointOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Record the session into this run folder.")
    ] = None,
    volts: Annotated[
        float, typer.Option(min=0.01, help="Largest jog voltage [V]; more in a valve's dead band.")
    ] = 0.15,
    idle: Annotated[
        float, typer.Option(min=1.0, help="End after this many seconds without a command.")
    ] = 300.0,
) -> None:
    """Let a screen jog, lock and unlock joints within their limits; refused during a run.

    Example: bramah manual --rig shinshu-2dof
    """
    from protocols.engine.manual import Manual
    from rig.bench.screens.sockets import AttachError, Publisher
    from rig.bench.session import Bench
    from rig.cli.errors import WorkError
    from rig.cli.execution.device import device_of, warn_of_limits
    from rig.runs.recorder import Recorder

    described, driver = device_of(rig, endpoint)
    warn_of_limits(described)
    try:
        publisher = Publisher(described.name)
    except AttachError as error:
        raise WorkError(f"manual: no screen could command this session: {error}") from error
    recorder = None if out is None else Recorder(out, described)
    with Bench(described, driver, recorder, publisher) as bench:
        progress("manual: page 9 of `bramah monitor` moves a joint; space stops")
        Manual(bench, described, volts=volts, idle_after=idle).run()
    typer.echo("manual session over; outputs at zero, confirmed by the device")
