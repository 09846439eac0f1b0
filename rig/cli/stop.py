"""The `stop` verb: outputs to zero now."""

from __future__ import annotations

import typer

from rig.cli.device import device_of, print_pressure
from rig.cli.options import EndpointOption, RigOption
from rig.cli.output import progress


def stop(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Put all outputs to zero now, whoever is in control; needs no run.

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
    typer.echo("outputs at zero, confirmed by the device")
    try:
        print_pressure(bench.pressurised(bench.probe(device_of(rig, endpoint)[1], described)))
    except DeviceError as error:
        progress(f"pressures not read: {error}")
