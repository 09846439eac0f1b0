"""The `reset` verb: a latched trip cleared by a person, with a reason."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.options import (
    EndpointOption,
    RigOption,
)


def reset(
    rig: RigOption,
    endpoint: EndpointOption = None,
    reason: Annotated[
        str, typer.Option(help="What was found and done; kept with the trip.  [required]")
    ] = "",
) -> None:
    """Clear a latched trip, in the device and on this computer, after a look at the bench.

    Example: bramah reset --rig shinshu-2dof --reason "pressure sensor 2 replaced"
    """
    from rig.cli.protocol_run import reset_device

    typer.echo(f"cleared: {reset_device(rig, endpoint, reason)}")
