"""The shipped drivers pass the conformance checks, each against a device of its own."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.conformance import Effort, Verdict, live_subject, run
from drivers.conformance.subject import Subject
from drivers.modbus_tcp import ModbusTcpDriver
from tests.drivers.conformance_benches import CAN, MODBUS_RTU, MODBUS_TCP, SERIAL
from tests.drivers.memory_bench import memory_subject
from tests.drivers.wires import device_process
from tests.hil_sim.integrator import seed_rig

pytest_plugins = ["drivers.conformance.plugin"]
SUBJECT = memory_subject()
QUICK = Effort(sequences=12, calls=20, shorten=False)
# A serial line's end is noticed by nobody, so there is nothing to cut.
NO_CUT = {"lost_host_zeroes", "zero_after_lost_link", "cut_link_is_lost"}


@pytest.mark.parametrize(
    ("subject", "skipped"),
    [(MODBUS_TCP, set()), (MODBUS_RTU, NO_CUT), (SERIAL, NO_CUT), (CAN, set())],
    ids=["tcp", "rtu", "serial", "can"],
)
def test_a_shipped_driver_conforms(subject: Subject, skipped: set[str]) -> None:
    report = run(subject, effort=QUICK)
    assert report.of(Verdict.FAILED) == ()
    assert {result.check for result in report.of(Verdict.SKIPPED)} == skipped


def test_a_device_that_is_there_is_checked_without_moving_it() -> None:
    with device_process("virtual") as (_, port):
        rig = seed_rig(port=port)
        still = run(live_subject(rig), outputs=False)
        driving = run(live_subject(rig), only=["zero_within_one_block", "waveform_is_played"])
        driver = ModbusTcpDriver(rig.wire, rig)
        driver.connect()
        assert driver.trip_cause() is None
        driver.close()
    assert still.conforms
    assert len(still.of(Verdict.PASSED)) >= 8
    assert driving.conforms
    assert len(driving.of(Verdict.PASSED)) == 2


def test_the_plugin_makes_a_test_of_each_check(conformance_check: Callable[[], None]) -> None:
    conformance_check()
