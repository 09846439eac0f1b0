"""Valves of CiA 408 on a bus: their states, and that they need their host's heartbeat."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import DeviceBusy, DeviceError, DeviceLost, OutputLaw
from drivers.canopen_408 import CanOpen408Driver, CanOpenValves
from drivers.registry import wire_at
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import cia408
from rig.model.wire.can_frames import CanFrame
from rig.model.wire.cia408 import Control, ValveState, next_state
from tests.drivers.can_bench import drop_all
from tests.drivers.valve_bus import HeldValves
from tests.drivers.wires import ROOT, device_at
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

PATIENCE = 30.0
DRIVING = [OutputLaw(bias=1.0, limit=2.0), OutputLaw(bias=-0.5, limit=2.0)]


def slow_rig() -> Rig:
    return seed_rig().model_copy(update={"sample_rate": 20.0})


@pytest.fixture(scope="module")
def at() -> Iterator[str]:
    with device_at("realtime", "canopen-408") as (_, endpoint):
        yield endpoint


def host(endpoint: str, watchdog: float = 5.0, number: int = 127) -> CanOpen408Driver:
    rig = slow_rig()
    wire = wire_at(f"{endpoint}?host={number}", rig.wire)
    return CanOpen408Driver(wire.model_copy(update={"watchdog": watchdog, "timeout": 5.0}), rig)


def test_valves_follow_their_set_points_and_return_to_zero(at: str) -> None:
    driver = host(at)
    assert driver.connect().identity.startswith("2 valve(s) of CiA 408")
    driver.start()
    before = driver.read_block()
    assert before.data[-1, 2] == pytest.approx(2.0e6, abs=200)  # the plant's pressure
    driver.apply(DRIVING)
    blocks = [driver.read_block() for _ in range(20)]
    after = blocks[-1].data[-1]
    assert after[10:] == pytest.approx([1.0, -0.5])
    assert after[0] == pytest.approx(0.1, abs=2e-3)  # the spool, by object 0x6301
    assert after[1] > before.data[-1, 1] + 1e-4  # the first piston extends
    assert after[5] < before.data[-1, 5] - 1e-4
    assert driver._valves._states == [ValveState.ACTIVE] * 2
    driver.zero_outputs()
    data = np.vstack([driver.read_block().data for _ in range(10)])
    assert np.all(data[:, 10:] == 0.0)
    assert driver._valves._states == [ValveState.HOLD] * 2
    driver.close()


@contextmanager
def tool(endpoint: str) -> Iterator[CanOpenValves]:
    """Nodes and bus of a tool beside the host."""
    reader = host(endpoint)._valves
    reader._port.open()
    reader._make_network()
    try:
        yield reader
    finally:
        reader._port.close()


def watched(endpoint: str) -> list[int]:
    """The heartbeats that the valves watch."""
    with tool(endpoint) as reader:
        return [node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw for node in reader._nodes]


@contextmanager
def driving(endpoint: str) -> Iterator[CanOpen408Driver]:
    """A host that drives the valves; they are without a fault at the end."""
    driver = host(endpoint)
    driver.connect()
    driver.start()
    driver.apply(DRIVING)
    while driver.read_block().data[-1, 0] < 0.09:
        pass
    yield driver
    driver.reset()
    driver.close()


def trip_of(driver: CanOpen408Driver) -> str:
    """The cause of a trip that a block reports, with the outputs of its last sample at zero."""
    blocks = [driver.read_block()]
    while not blocks[-1].tripped:
        assert len(blocks) < 100
        blocks.append(driver.read_block())
    assert np.all(driver.read_block().data[-1, 10:] == 0.0)
    return driver.trip_cause() or ""


def test_a_valve_s_own_fault_trips_the_run_that_drives_it(at: str) -> None:
    with driving(at) as driver, tool(at) as other:
        # A watch of 20 ms on a heartbeat that comes every second.
        other._nodes[0].sdo[cia408.CONSUMER_HEARTBEAT][1].raw = 127 << 16 | 20
        assert "valve 1 is in FAULT_DISABLED" in trip_of(driver)


def test_a_valve_that_restarts_or_leaves_operation_trips_the_run(at: str) -> None:
    for states, cause in ((b"\0", "valve 2 has restarted"), (b"\5\4", "is in NMT state 4")):
        with driving(at) as driver, tool(at) as other:
            for state in states:
                other._port.send(CanFrame(cia408.HEARTBEAT_ID + 2, bytes([state])))
            assert cause in trip_of(driver)


def test_an_emergency_of_a_valve_is_in_the_log(at: str, caplog: pytest.LogCaptureFixture) -> None:
    with driving(at) as driver, tool(at) as other:
        other._port.send(CanFrame(cia408.EMERGENCY_ID + 1, bytes([0x10, 0x23, 1, 0, 0, 0, 0, 0])))
        while "valve 1: emergency 0x2310, register 0x01" not in caplog.text:
            assert not driver.read_block().tripped


def test_a_stop_takes_the_valves_out_of_operation_before_anything_else(at: str) -> None:
    """Listening for another host and configuring the valves take half a second."""
    driver = host(at)
    with driving(at) as first:
        frames: list[CanFrame] = []
        send = driver._valves._port.send

        def noted(frame: CanFrame) -> None:
            frames.append(frame)
            send(frame)

        driver._valves._port.send = noted  # type: ignore[method-assign]
        driver.zero_outputs()
        assert [(f.identifier, f.data) for f in frames[:2]] == [(0, b"\x80\x01"), (0, b"\x80\x02")]
        assert watched(at) == [0, 0]
        first.connect()


def test_valves_that_a_host_of_another_number_drives_are_refused(at: str) -> None:
    """Its own end would switch off the watch that the valves have on the first."""
    with driving(at) as first:
        watch = watched(at)
        second = host(at, number=126)
        ended = threading.Event()
        beating = threading.Thread(target=_served, args=(first, ended))
        beating.start()
        with pytest.raises(DeviceBusy, match="another host with the number 127 drives the valves"):
            second.connect()
        second.close()
        ended.set()
        beating.join(PATIENCE)
        assert watched(at) == watch == [127 << 16 | 5000] * 2


def test_a_host_that_ends_leaves_the_watch_that_the_valves_have_on_another(at: str) -> None:
    first = host(at)
    first.connect()
    with tool(at) as other:
        for node in other._nodes:
            node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw = 126 << 16 | 5000
    first.close()
    assert watched(at) == [126 << 16 | 5000] * 2


def test_a_bus_that_has_gone_is_named_as_the_cause() -> None:
    rig = seed_rig()
    with HeldValves(rig, IntegratorPlant(rig)) as valves:
        driver = valves.driver(rig)
        driver.connect()
        driver.start()
        driver.read_block()
        server, send = valves._server, driver._valves._port.send

        def cut(frame: CanFrame) -> None:
            if frame.identifier == cia408.SYNC_ID:
                valves.adapter.inside(lambda: drop_all(server))
            else:
                send(frame)

        driver._valves._port.send = cut  # type: ignore[method-assign]
        with pytest.raises(DeviceLost, match="has gone: ") as lost:
            driver.read_block()
        assert "Traceback" not in str(lost.value)
        driver.close()


def _served(driver: CanOpen408Driver, ended: threading.Event) -> None:
    while not ended.is_set():
        driver.read_block()


def test_valves_that_another_host_drives_are_refused_but_for_a_stop(at: str) -> None:
    """A second host would take away the watch on the first, whose valves then stay open."""
    first, second = host(at), host(at)
    first.connect()
    first.start()
    first.apply(DRIVING)
    ended: list[DeviceError] = []

    def run() -> None:
        try:
            while True:
                first.read_block()
        except DeviceError as error:
            ended.append(error)

    at_work = threading.Thread(target=run)
    at_work.start()
    watch = watched(at)
    assert all(watch)
    with pytest.raises(DeviceBusy, match="another host with the number 127 drives the valves"):
        second.connect()
    second.close()
    assert watched(at) == watch
    assert not ended
    assert first._valves._states == [ValveState.ACTIVE] * 2
    second.zero_outputs()
    at_work.join(PATIENCE)
    assert [type(error) for error in ended] == [DeviceLost]
    first.close()
    third = host(at)
    third.connect()  # nobody is heard any more
    third.start()
    assert np.all(third.read_block().data[:, 10:] == 0.0)
    assert third.trip_cause() is None
    third.close()


def test_a_host_that_says_goodbye_leaves_no_fault(at: str) -> None:
    driver = host(at, watchdog=0.4)
    driver.connect()
    driver.start()
    driver.read_block()
    driver.close()
    time.sleep(1.0)
    driver.connect()
    assert driver.trip_cause() is None
    driver.close()


def test_a_host_busy_elsewhere_with_outputs_at_zero_loses_no_valve(at: str) -> None:
    """Between connecting and the first sample the head of the run is written to a slow disk."""
    driver = host(at, watchdog=0.5)
    driver.connect()
    time.sleep(1.5)
    driver.start()
    assert not driver.read_block().tripped
    assert driver.trip_cause() is None
    driver.close()


def test_a_host_that_stands_still_with_outputs_on_leaves_valves_in_fault(at: str) -> None:
    driver = host(at, watchdog=0.4)
    driver.connect()
    driver.start()
    driver.apply(DRIVING)
    while driver.read_block().data[-1, 0] < 0.09:
        pass
    time.sleep(1.0)  # its threads go on
    driver.zero_outputs()
    driver.read_block()
    assert "valve 1 is in FAULT_DISABLED" in (driver._valves.fault() or "")
    driver.reset()
    driver.close()


def test_a_trip_of_one_computer_refuses_the_others_until_a_reset(at: str) -> None:
    first, other = host(at, watchdog=0.4), host(at)
    first.connect()
    first.start()
    first.apply(DRIVING)
    first.read_block()
    first.close_tripped()
    other.connect()
    assert "valve 1 is in FAULT_DISABLED" in (other.trip_cause() or "")
    other.reset()
    other.start()
    other.apply(DRIVING)
    other.close()


HOST = """
import sys
from drivers.base import OutputLaw
from tests.drivers.test_canopen_408 import host

driver = host(sys.argv[1], watchdog=0.4)
driver.connect()
driver.start()
driver.apply([OutputLaw(bias=1.0, limit=2.0)] * 2)
while True:
    if driver.read_block().data[-1, 0] > 0.09:
        print("driving", flush=True)
"""


@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGSTOP])
def test_a_host_that_ends_or_stands_still_leaves_valves_in_fault(
    at: str, sign: signal.Signals
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOST, at], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as driving:
        assert driving.stdout is not None
        assert driving.stdout.readline() == "driving\n"
        os.kill(driving.pid, sign)
        time.sleep(1.0)
        driver = host(at)
        driver.connect()
        driving.kill()
        driving.wait(PATIENCE)
    assert "valve 1 is in FAULT_DISABLED: it missed the host's heartbeat" in (
        driver.trip_cause() or ""
    )
    driver.start()
    block = driver.read_block()
    assert block.tripped
    assert block.data[-1, 0] == pytest.approx(0.0, abs=1e-3)  # the spool has closed
    with pytest.raises(DeviceError, match=r"tripped: valve 1 .*reset"):
        driver.apply(DRIVING)
    driver.reset()
    driver.start()
    driver.apply(DRIVING)
    data = np.vstack([driver.read_block().data for _ in range(10)])
    assert data[-1, 10:] == pytest.approx([1.0, -0.5])
    driver.close()


def test_a_bus_without_the_valve_names_the_node(at: str) -> None:
    rig = slow_rig()
    wire = wire_at(at, rig.wire).model_copy(update={"timeout": 0.3})
    wrong = wire.reached_by("canopen-408", {**wire.settings, "nodes": [1, 9]})
    with pytest.raises(DeviceLost, match=r"no valve answers as node 9 .*node numbers"):
        CanOpen408Driver(wrong, rig).connect()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"nodes": [1]}, r"nodes: \[1\]; expected 2 different numbers"),
        ({"nodes": [1, 127]}, ".*none of them the host's 127"),
        ({"eds": "absent.eds"}, "eds: absent.eds: No such file"),
        ({"bus": "nowhere/1"}, "bus: no interface 'nowhere'"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, object], says: str) -> None:
    wire = Wire(kind="canopen-408", **{"bus": "virtual/x", **settings})
    with pytest.raises(InputError, match=f"wire: {says}"):
        CanOpen408Driver(wire, slow_rig())


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("ParameterName=piston", "ParameterName=stroke", "no TPDO carries piston, which piston_1"),
        ("0x60410010", "0x21000110", "no TPDO carries object 0x6041"),
        ("[6041]", "[6099", "not an EDS file of a valve"),
    ],
)
def test_an_eds_file_that_lacks_something_is_refused(
    tmp_path: Path, before: str, after: str, says: str
) -> None:
    file = tmp_path / "my.eds"
    assert before in cia408.shipped_eds()
    file.write_text(cia408.shipped_eds().replace(before, after, 1), "utf-8")
    wire = Wire(kind="canopen-408", bus="virtual/x", eds=str(file))
    with pytest.raises(InputError, match=rf"my.eds: {says}") as caught:
        CanOpen408Driver(wire, slow_rig())
    assert "\n" not in str(caught.value)


words = st.lists(st.integers(0, 15), max_size=30)


@given(st.sampled_from(ValveState), words)
def test_only_all_three_bits_make_a_valve_active_and_only_a_reset_ends_a_fault(
    state: ValveState, sent: list[int]
) -> None:
    before = 0
    for word in sent:
        after = next_state(state, before, word)
        if state.in_fault:
            rising = bool(word & Control.RESET) and not before & Control.RESET
            assert after == (ValveState.DISABLED if rising else state)
        else:
            assert (after == ValveState.ACTIVE) == (word & 7 == 7)
            assert not after.in_fault
        state, before = after, word
