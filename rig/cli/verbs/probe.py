"""The `probe` verb: one block of every channel, without moving anything."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rig.cli.execution.device import device_of, pressure_text
from rig.cli.options import EndpointOption, JsonOption, RigOption
from rig.cli.text.output import print_result, table
from rig.model.units import READINGS, display_unit

if TYPE_CHECKING:
    from rig.bench.probe import Reading


def probe(rig: RigOption, endpoint: EndpointOption = None, json: JsonOption = None) -> None:
    """Read one block of every channel without moving anything; exit 1 on implausible values.

    If the host times the samples, their lateness is measured as well.

    Example: bramah probe --rig shinshu-2dof
    """
    from drivers.base import DeviceBusy
    from rig.bench import probe as bench
    from rig.bench.latch import BenchState
    from rig.cli.errors import WorkError
    from rig.model.trips import reset_command

    described, driver = device_of(rig, endpoint)
    state = BenchState(described.wire)
    with state.occupied():
        try:
            readings, timing, cause = bench.probe_timed(driver, described)
        except DeviceBusy as error:
            raise state.in_use(error) from error
    header = ("channel", "mean", "least", "most", "unit", "codes", "")
    rows = [_row(reading) for reading in readings]
    print_result(json, [asdict(reading) for reading in readings], table(header, rows))
    to_stderr = json == Path("-")
    if timing is not None:
        typer.echo(
            f"host-timed: {timing.samples} samples taken {1e3 * timing.mean:.3g} ms late, standard "
            f"deviation {1e3 * timing.jitter:.3g} ms; in the rig file: wire: jitter: "
            f"{1e3 * timing.jitter:.3g} ms",
            err=to_stderr,
        )
    latched = state.read_trip()
    trips = [text for text in (latched and latched.trip, cause) if text]
    if trips:
        typer.echo(
            f"tripped: {'; '.join(trips)}; clear it with `{reset_command(described)}`",
            err=to_stderr,
        )
    if text := pressure_text(readings):
        typer.echo(text, err=to_stderr)
    implausible = [reading.channel for reading in readings if reading.mark != bench.GOOD]
    if implausible:
        raise WorkError(f"not plausible: {', '.join(implausible)}; the last column says why")


def _row(reading: Reading) -> tuple[str, ...]:
    unit = display_unit(reading.unit, READINGS)
    values = (reading.mean, reading.low, reading.high)
    return (
        reading.channel,
        *(f"{unit.scale * value:.5g}" for value in values),
        unit.text,
        f"{reading.codes[0]}..{reading.codes[1]}",
        reading.mark,
    )
