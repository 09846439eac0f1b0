"""A driver under test: how to get a fresh device, and what driver and device claim to be able to.

Glossary: a *subject* is a driver together with a device to try it on; a *bench* is one fresh
device with what a test may do to it; a *probe* reads the device's outputs by another way than the
driver under test; a *fault* is a name for what the wire can be made to do to answers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from drivers.base import Driver
from rig.model.rig import Rig

Probe = Callable[[], Sequence[float]]
Act = Callable[[], None]

HEALTHY = "pass"  # the fault that is none


@dataclass(frozen=True)
class Capabilities:
    """What driver and device claim; a check that needs what is not claimed is skipped, and said.

    `outputs`: laws drive outputs (False: the device only plays samples). `host_timed`: the driver
    evaluates the laws at the host's rate; its blocks may lag, and `stop` ends the laws.
    `virtual_time`: the device's clock stands still while nobody reads. `latches_trips`: after a
    loss of the host the device keeps its outputs at zero until `reset`. `refuses_other_rigs`: the
    device can tell which rig it is.
    """

    outputs: bool = True
    host_timed: bool = False
    virtual_time: bool = True
    latches_trips: bool = True
    refuses_other_rigs: bool = True


@dataclass(frozen=True)
class DeviceUnderTest:
    """One fresh device, its outputs at zero and not tripped, and what can be done to it.

    `driver` makes an unconnected driver for a rig. `outputs` returns every output [V] after at
    least one further sample of the device's clock. `cut` ends the link as the death of the
    host's process does. `silence` lets more time pass than the watchdog allows, without a word
    of the host. `spoil` makes the wire do one of `faults` from then on, or be healthy again
    (`HEALTHY`). `lost` names the faults after which no answer arrives any more. `saturate` puts a
    sensor at an end of its range and returns the column. What a bench cannot do is None or empty.
    """

    rig: Rig
    driver: Callable[[Rig], Driver]
    outputs: Probe | None = None
    cut: Act | None = None
    silence: Act | None = None
    spoil: Callable[[str], None] | None = None
    faults: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    saturate: Callable[[], int] | None = None


@dataclass(frozen=True)
class Subject:
    """A driver under test; `make` opens a fresh bench and ends it afterwards.

    `volts` is the largest output [V] that the checks ask for; it must lie below every joint's
    `limits.command` and well above the steps of the output converters.
    """

    name: str
    make: Callable[[], AbstractContextManager[DeviceUnderTest]]
    capabilities: Capabilities = Capabilities()
    volts: float = 1.0
