"""The `stop` verb: outputs to zero now."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import typer

from rig.cli.device import device_of, print_pressure
from rig.cli.options import EndpointOption, RigOption
from rig.cli.output import progress

if TYPE_CHECKING:
    from rig.model.parts import Wire

# A run that was told to stop records its outputs at zero, for 6 s and two answer times at most.
RECORDS_ZERO: Final = 15.0  # [s]


def stop(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Put all outputs to zero now, whoever is in control, and end the run that put them out.

    Example: bramah stop --rig shinshu-2dof
    """
    from drivers.base import DeviceError
    from rig.bench import probe as bench
    from rig.bench.outputs import UNSURE

    described, driver = device_of(rig, endpoint)
    try:
        driver.zero_outputs()
    except DeviceError as error:
        watchdog = described.wire.watchdog
        raise type(error)(
            f"{UNSURE}: {error}; use the emergency stop (the device's "
            f"watchdog zeroes them {watchdog:g} s after its host has fallen silent)"
        ) from error
    finally:
        driver.close()
    _end_run(described.wire)
    typer.echo("outputs at zero, confirmed by the device")
    try:
        print_pressure(bench.pressurised(bench.probe(device_of(rig, endpoint)[1], described)))
    except DeviceError as error:
        progress(f"pressures not read: {error}")


def _end_run(wire: Wire) -> None:
    """End what drives the bench from this computer: its next law would move the joints again.

    Raises DeviceBusy where it goes on.
    """
    from drivers.base import DeviceBusy
    from rig.bench.latch import BenchState
    from rig.bench.outputs import UNSURE

    state = BenchState(wire)
    holder = state.holder()
    if holder is None or holder.pid == os.getpid():
        return
    run = f", which writes {holder.run}," if holder.run else ""
    progress(f"stopping process {holder.pid}{run} as well")
    with suppress(ProcessLookupError):  # it ended by itself
        os.kill(holder.pid, signal.SIGTERM)
    deadline = time.monotonic() + RECORDS_ZERO
    while state.holder() == holder:
        if time.monotonic() > deadline:
            raise DeviceBusy(
                f"{UNSURE}: process {holder.pid}{run or ','} was told to stop and goes on; use the "
                "emergency stop"
            )
        time.sleep(0.05)
