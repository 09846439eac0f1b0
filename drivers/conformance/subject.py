"""A driver under test: how to make a fresh device, and the capabilities claimed for both.

Glossary: a *subject* is a driver together with a device to try it on; a *bench* is one fresh device
with a test's means of acting on it; a *probe* reads the device's outputs independently of the
driver under test; a *fault* names a disturbance of answers by the wire.
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

_SHARE_OF_LIMIT = 0.1  # of the smallest command limit: the most that a real device puts out

HEALTHY = "pass"  # no fault


@dataclass(frozen=True)
class Capabilities:
    """Claims about driver and device; a check that needs an unclaimed one is skipped, with notice.

    `outputs`: laws drive outputs (False: the device only plays samples). `host_timed`: the driver
    evaluates the laws at the host's rate; its blocks may lag, and `stop` ends the laws.
    `virtual_time`: the device's clock stands still without reads. `latches_trips`: after a loss of
    the host the device keeps its outputs at zero until `reset`. `refuses_other_rigs`: the device
    can compare its rig with the host's.
    """

    outputs: bool = True
    host_timed: bool = False
    virtual_time: bool = True
    latches_trips: bool = True
    refuses_other_rigs: bool = True


@dataclass(frozen=True)
class DeviceUnderTest:
    """One fresh device, its outputs at zero and not tripped, and actions on it.

    `driver` makes an unconnected driver for a rig. `outputs` returns every output [V] after at
    least one further sample of the device's clock. `cut` ends the link as the death of the host's
    process does. `silence` waits longer than the watchdog allows, without a message of the host.
    `spoil` makes the wire apply one of `faults` from then on, or none (`HEALTHY`). `lost` names the
    faults after which no answer arrives. `saturate` puts a sensor at an end of its range and
    returns the column. Actions that a bench lacks are None or empty.
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

    `volts` is the largest output [V] that the checks request; it must lie below every joint's
    `limits.command` and well above the steps of the output converters.
    """

    name: str
    make: Callable[[], AbstractContextManager[DeviceUnderTest]]
    capabilities: Capabilities = Capabilities()
    volts: float = 1.0


def live_subject(rig: Rig) -> Subject:
    """Return the device at the rig's wire as a subject.

    Its properties (virtual time, host-timed) are read from it. Raises InputError for settings that
    its driver cannot read, DeviceError where it does not answer or has tripped: checks clear no
    trip of a machine.
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
        yield DeviceUnderTest(rig, lambda other: make_driver(other.wire, other))

    host_timed = driver_class(rig.wire.kind).host_timed
    claims = Capabilities(
        host_timed=host_timed,
        virtual_time=info.virtual_time,
        # A device that only reads and writes stores neither a sample rate nor a rig.
        refuses_other_rigs=not host_timed,
    )
    volts = _SHARE_OF_LIMIT * min(joint.limits.command for joint in rig.joints)
    return Subject(rig.wire.kind, make, claims, volts)
