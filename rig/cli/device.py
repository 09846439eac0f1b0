"""The device that a verb talks to, and what it leaves under pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from drivers.base import Driver
    from rig.model.rig import Rig


def device_of(rig: str, endpoint: str | None) -> tuple[Rig, Driver]:
    """Return a rig and the unconnected driver of its wire, or of an endpoint instead."""
    from drivers import make_driver, wire_at
    from rig.runs.rigs import load_bench

    described = load_bench(rig)
    wire = described.wire if endpoint is None else wire_at(endpoint, described.wire)
    return described, make_driver(wire, described)


def print_pressure(places: list[str], *, aside: bool = False) -> None:
    """Print what is still under pressure, if anything is; `aside`: to standard error."""
    if places:
        typer.echo(f"still under pressure: {', '.join(places)}", err=aside)
