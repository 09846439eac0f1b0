"""The `reset` verb: a person clears a latched trip and gives a reason."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.options import EndpointOption, KnownRigOption


def reset(
    rig: KnownRigOption = None,
    endpoint: EndpointOption = None,
    reason: Annotated[
        str, typer.Option(help="Cause found and action taken; stored with the trip.  [required]")
    ] = "",
) -> None:
    """Clear a latched trip in the device and on this computer, after inspecting the bench.

    Example: bramah reset --reason "pressure sensor 2 replaced"
    """
    from rig.cli.execution.protocol_run import reset_device

    typer.echo(f"cleared: {reset_device(rig, endpoint, reason)}")
