"""The shipped drivers pass the conformance checks, each against a device of its own."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.conformance import Effort, Verdict, live_subject, run
from drivers.modbus_tcp import ModbusTcpDriver
from hil_sim.faults import CLASSES
from hil_sim.faults.wire import WireFault
from tests.drivers.can_bench import CAN
from tests.drivers.conformance_benches import FAULTS, FEW, on_wire
from tests.drivers.memory_bench import memory_subject
from tests.drivers.wires import device_process
from tests.hil_sim.integrator import seed_rig

pytest_plugins = ["drivers.conformance.plugin"]
SUBJECT = memory_subject()
QUICK = Effort(sequences=12, calls=20, shorten=False)


@pytest.mark.parametrize("wire", [*FEW, "can"])
def test_a_shipped_driver_conforms_over_a_wire_that_fails(wire: str) -> None:
    report = run(CAN if wire == "can" else on_wire(wire, FEW[wire]), effort=QUICK)
    assert report.of(Verdict.FAILED) == ()
    assert report.of(Verdict.SKIPPED) == ()


def test_every_fault_of_the_wire_is_tried() -> None:
    names = {kind.fault_name() for kind in CLASSES if issubclass(kind, WireFault)}
    for wire, faults in FAULTS.items():
        tried = {fault.name for fault in faults.values()}
        # TCP's checksum lets no flipped bit pass; `short` and `miscounted` stand for a gateway.
        assert names - tried == ({"bits_flipped"} if wire == "modbus-tcp" else set())


def test_a_device_that_is_there_is_checked_without_moving_it() -> None:
    with device_process("virtual") as (_, port):
        rig = seed_rig(port=port)
        still = run(live_subject(rig), outputs=False)
        driving = run(live_subject(rig), only=["zero_within_one_block", "waveform_is_played"])
        driver = ModbusTcpDriver(rig.wire, rig)
        driver.connect()
        assert driver.trip_cause() is None
        driver.close()
    assert not still.of(Verdict.FAILED)
    assert len(still.of(Verdict.PASSED)) >= 8
    assert not driving.of(Verdict.FAILED)
    assert len(driving.of(Verdict.PASSED)) == 2


def test_the_plugin_makes_a_test_of_each_check(conformance_check: Callable[[], None]) -> None:
    conformance_check()
