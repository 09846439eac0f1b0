"""Verbs that move nothing: `probe` reads one block, `stop` zeroes the outputs, `depressurise`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rig.cli.bench_commands import EndpointOption, JsonOption, RigOption
from rig.cli.output import progress, table, write_json

if TYPE_CHECKING:
    from drivers.base import Driver
    from rig.bench.probe import Reading
    from rig.model.rig import Rig


def probe(rig: RigOption, endpoint: EndpointOption = None, json: JsonOption = None) -> None:
    """Read one block of every channel and move nothing; exit 1 where a channel is not plausible.

    Example: bramah probe --rig shinshu-2dof
    """
    from rig.bench import probe as bench
    from rig.cli.errors import WorkError

    described, driver = _device(rig, endpoint)
    found = bench.probe(driver, described)
    write_json(json, [asdict(one) for one in found])
    if json != Path("-"):
        header = ("channel", "mean", "least", "most", "unit", "codes", "")
        typer.echo(table(header, [_row(one) for one in found]))
    _say_pressure(bench.pressurised(found))
    odd = [one.channel for one in found if one.mark != bench.GOOD]
    if odd:
        raise WorkError(f"not plausible: {', '.join(odd)}; look at the last column")


def stop(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Put all outputs to zero now, whoever is in control; needs no run.

    Example: bramah stop --rig shinshu-2dof
    """
    from drivers.base import DeviceError
    from rig.bench import probe as bench

    described, driver = _device(rig, endpoint)
    try:
        driver.zero_outputs()
    except DeviceError as error:
        watchdog = described.wire.watchdog
        raise type(error)(
            f"OUTPUTS NOT CONFIRMED AT ZERO: {error}; use the emergency stop (the device's "
            f"watchdog zeroes them {watchdog:g} s after its host has fallen silent)"
        ) from error
    finally:
        driver.close()
    typer.echo("outputs at zero, confirmed by the device")
    try:
        _say_pressure(bench.pressurised(bench.probe(_device(rig, endpoint)[1], described)))
    except DeviceError as error:
        progress(f"pressures not read: {error}")


def depressurise(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Let the pressure out where the rig can; zeroes the outputs first.

    Example: bramah depressurise --rig shinshu-2dof
    """
    from rig.bench import probe as bench
    from rig.cli.errors import WorkError

    stop(rig, endpoint)
    described, driver = _device(rig, endpoint)
    left = bench.pressurised(bench.probe(driver, described))
    if left:
        raise WorkError(
            f"rig {described.name!r} describes no way to let the pressure out: stop the pump and "
            f"open the relief by hand; still under pressure: {', '.join(left)}"
        )


def _device(rig: str, endpoint: str | None) -> tuple[Rig, Driver]:
    from drivers import make_driver, wire_at
    from rig.runs.rigs import load_bench

    described = load_bench(rig)
    wire = described.wire if endpoint is None else wire_at(endpoint, described.wire)
    return described, make_driver(wire, described)


def _row(one: Reading) -> tuple[str, ...]:
    numbers = (f"{value:.5g}" for value in (one.mean, one.low, one.high))
    return (one.channel, *numbers, one.unit, f"{one.codes[0]}..{one.codes[1]}", one.mark)


def _say_pressure(places: list[str]) -> None:
    if places:
        typer.echo(f"still under pressure: {', '.join(places)}")


def register(app: typer.Typer) -> None:
    """Add these verbs to the command line."""
    for verb in (probe, stop, depressurise):
        app.command()(verb)
