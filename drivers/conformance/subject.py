"""A driver under test: how to get a fresh device, and what driver and device claim to be able to.

Glossary: a *subject* is a driver together with a device to try it on; a *bench* is one fresh
device with what a test may do to it; a *probe* reads the device's outputs by another way than the
driver under test; a *fault* is a name for what the wire can be made to do to answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from drivers.base import DeviceError, Driver
from drivers.registry import driver_class, make_driver
from rig.model.rig import Rig

Probe = Callable[[], Sequence[float]]
Act = Callable[[], None]

_PART = 0.1  # of the smallest command limit, asked for where outputs are allowed

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


def live_subject(rig: Rig) -> Subject:
    """Return the device that the rig's wire reaches as a subject.

    What it is (virtual time, host-timed) is asked of it. Raises InputError for settings that its
    driver cannot read, DeviceError where it does not answer or has tripped: checks clear no trip
    of a machine.
    """
    driver = make_driver(rig.wire, rig)
    try:
        info = driver.connect()
        tripped = driver.trip_cause()
    finally:
        driver.close()
    if tripped is not None:
        raise DeviceError(f"the device has tripped ({tripped}); find the cause, then reset it")

    @contextmanager
    def make() -> Iterator[DeviceUnderTest]:
        yield DeviceUnderTest(rig, lambda wanted: make_driver(wanted.wire, wanted))

    claims = Capabilities(
        host_timed=driver_class(rig.wire.kind).host_timed,
        virtual_time=info.virtual_time,
    )
    volts = _PART * min(joint.limits.command for joint in rig.joints)
    return Subject(rig.wire.kind, make, claims, volts)
