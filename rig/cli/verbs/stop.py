"""The `stop` verb: outputs set to zero at once."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import typer

from rig.cli.execution.device import device_of, print_pressure, refuse_endpoint_alone
from rig.cli.options import EndpointOption, KnownRigOption
from rig.cli.text.output import progress

if TYPE_CHECKING:
    from drivers.base import Driver
    from rig.bench.latch import Holder
    from rig.model.parts import Wire

NOT_IN_USE: Final = "no process of this computer drives a bench"
# A stopped run records its outputs at zero, for at most 6 s and two answer times.
RECORDS_ZERO: Final = 15.0  # [s]
# The next law of another computer's run may overwrite a single zero command.
ZEROS: Final = 6
BETWEEN_ZEROS: Final = 0.2  # [s]


def stop(rig: KnownRigOption = None, endpoint: EndpointOption = None) -> None:
    """Set all outputs to zero now, whoever is in control, and end the run that drives them.

    Without --rig it stops every bench that this computer drives.

    Example: bramah stop --rig shinshu-2dof
    """
    from drivers.base import DeviceError
    from rig.bench.latch import rigs_in_use
    from rig.model.parse import InputError

    refuse_endpoint_alone(rig, endpoint)
    rigs = [rig] if rig is not None else [str(path) for path in rigs_in_use()]
    if not rigs:
        raise InputError(f"{NOT_IN_USE}; name the bench: --rig RIG")
    errors: list[Exception] = []
    for name in rigs:  # an error of one bench must not keep another from being stopped
        try:
            stop_bench(name, endpoint)
        except (InputError, DeviceError) as error:
            errors.append(error)
    for further in errors[1:]:
        progress(str(further))
    if errors:
        raise errors[0]


def stop_bench(rig: str, endpoint: str | None) -> None:
    """Set the outputs of one bench to zero, end the run that drives it, print what is pressurised.

    Raises InputError and DeviceError.
    """
    from drivers.base import DeviceError
    from rig.bench import probe as bench
    from rig.bench.outputs import UNSURE

    bench_rig, driver = device_of(rig, endpoint)
    try:
        _zero(driver, bench_rig.wire)
    except DeviceError as error:
        watchdog = bench_rig.wire.watchdog
        raise type(error)(
            f"{UNSURE}: {error}; use the emergency stop (the device's watchdog "
            f"zeroes the outputs {watchdog:g} s after the host's last message)"
        ) from error
    finally:
        driver.close()
    _end_run(bench_rig.wire)
    typer.echo("outputs at zero, confirmed by the device")
    try:
        print_pressure(bench.pressurised(bench.probe(device_of(rig, endpoint)[1], bench_rig)))
    except DeviceError as error:
        progress(f"pressures not read: {error}")


def _zero(driver: Driver, wire: Wire) -> None:
    """Zero the outputs, several times where a run of another computer may still set them.

    A process of this computer that drives the bench may take the device's answers from the line: if
    they are missing it is ended, which zeroes the outputs too. Raises DeviceError without an answer
    after that.
    """
    from drivers.base import DeviceError

    try:
        driver.zero_outputs()  # before anything else
    except DeviceError:
        if _holder(wire) is None:
            raise
        _end_run(wire)
        driver.zero_outputs()
    elsewhere = _holder(wire) is None
    for _ in range(ZEROS - 1 if elsewhere else 0):
        time.sleep(BETWEEN_ZEROS)
        driver.zero_outputs()


def _end_run(wire: Wire) -> None:
    """End the process of this computer that drives the bench, or its next law moves joints again.

    Raises DeviceBusy if the process does not end.
    """
    from drivers.base import DeviceBusy
    from rig.bench.outputs import UNSURE

    holder = _holder(wire)
    if holder is None:
        return
    run = f", which writes {holder.run}," if holder.run else ""
    progress(f"stopping process {holder.pid}{run} as well")
    with suppress(ProcessLookupError):  # the process has ended by itself
        os.kill(holder.pid, signal.SIGTERM)
    deadline = time.monotonic() + RECORDS_ZERO
    while _holder(wire) == holder:
        if time.monotonic() > deadline:
            raise DeviceBusy(
                f"{UNSURE}: process {holder.pid}{run or ','} was told to stop but runs on; use the "
                "emergency stop"
            )
        time.sleep(0.05)


def _holder(wire: Wire) -> Holder | None:
    """Return the other process of this computer that holds the bench, None if there is none."""
    from rig.bench.latch import holder_at

    holder = holder_at(wire)
    return None if holder is None or holder.pid == os.getpid() else holder
