"""The device that a verb talks to, and what it leaves under pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from drivers.base import Driver
    from rig.model.rig import Rig


def reached_at(rig: Rig, endpoint: str | None) -> Rig:
    """Return a rig with the wire of an endpoint; without one, as it is."""
    from drivers import wire_at

    if endpoint is None:
        return rig
    return rig.model_copy(update={"wire": wire_at(endpoint, rig.wire)})


def device_of(rig: str, endpoint: str | None) -> tuple[Rig, Driver]:
    """Return a rig, reached at an endpoint if one is given, and its unconnected driver."""
    from drivers import make_driver
    from rig.runs.rigs import load_bench

    described = reached_at(load_bench(rig), endpoint)
    return described, make_driver(described.wire, described)


def print_pressure(places: list[str], *, aside: bool = False) -> None:
    """Print what is still under pressure, if anything is; `aside`: to standard error."""
    if places:
        typer.echo(f"still under pressure: {', '.join(places)}", err=aside)
