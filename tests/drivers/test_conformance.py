"""The shipped drivers pass the conformance checks, each against a device of its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from drivers.conformance import CheckVerdict, RandomCallBudget, Subject, live_subject, run
from drivers.conformance.catalogue import IDENTITY
from drivers.modbus_tcp import ModbusTcpDriver
from hil_sim.device.server import TCP
from hil_sim.faults import CLASSES
from hil_sim.faults.wire import WireFault
from tests.drivers.can_bench import can_subject
from tests.drivers.conformance_benches import FAULTS, FEW, on_wire
from tests.drivers.memory_bench import memory_subject
from tests.drivers.valve_bus import valves_subject
from tests.drivers.wires import device_process
from tests.hil_sim.integrator import seed_rig
from tests.variants import kept

pytest_plugins = ["drivers.conformance.plugin"]
SUBJECT = memory_subject()
QUICK = RandomCallBudget(sequences=5, calls=16, shorten=False)
SHORT = RandomCallBudget(sequences=3, calls=12, shorten=False)
WIRES: dict[str, Callable[[], Subject]] = {
    **{wire: partial(on_wire, wire, names) for wire, names in FEW.items()},
    "can, in its adapter": partial(can_subject, ("flip", "noise")),
    "canopen-408": partial(valves_subject, ("lose one", "late")),
}


@pytest.mark.parametrize("wire", kept(WIRES, (list(WIRES).index(TCP),)))
def test_a_shipped_driver_conforms_over_a_wire_that_fails(wire: str) -> None:
    subject = WIRES[wire]()
    report = run(subject, effort=QUICK if wire == TCP else SHORT)
    assert report.of(CheckVerdict.FAILED) == ()
    # Valves are no bench: they know neither the rig nor its sample rate.
    no_bench = not subject.capabilities.refuses_other_rigs
    skipped = {result.check: result.reason for result in report.of(CheckVerdict.SKIPPED)}
    assert skipped == ({"other_rig_refused": f"not claimed: {IDENTITY}"} if no_bench else {})


def test_every_fault_of_the_wire_is_tried() -> None:
    names = {kind.fault_name() for kind in CLASSES if issubclass(kind, WireFault)}
    for wire, faults in FAULTS.items():
        tried = {fault.name for fault in faults.values()}
        # TCP's checksum lets no flipped bit pass; `short` and `miscounted` stand for a gateway.
        assert names - tried == ({"bits_flipped"} if wire == TCP else set())


def test_a_device_that_is_there_is_checked_without_moving_it() -> None:
    with device_process("virtual") as (_, port):
        rig = seed_rig(port=port)
        still = run(live_subject(rig), outputs=False)
        driving = run(live_subject(rig), only=["zero_within_one_block", "waveform_is_played"])
        driver = ModbusTcpDriver(rig.wire, rig)
        driver.connect()
        assert driver.trip_cause() is None
        driver.close()
    assert not still.of(CheckVerdict.FAILED)
    assert len(still.of(CheckVerdict.PASSED)) >= 8
    assert not driving.of(CheckVerdict.FAILED)
    assert len(driving.of(CheckVerdict.PASSED)) == 2


def test_the_plugin_makes_a_test_of_each_check(conformance_check: Callable[[], None]) -> None:
    conformance_check()
