"""A device that is there, as a subject: nothing can be done to it but talk to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.base import DeviceError
from drivers.conformance.subject import Capabilities, DeviceUnderTest, Subject
from drivers.registry import driver_class, make_driver
from rig.model.rig import Rig

_PART = 0.1  # of the smallest command limit, asked for where outputs are allowed


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
