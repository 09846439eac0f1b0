"""The device zeroes its outputs by itself: a silent host, a lost wire, a fault; and who may."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal, Status, TripCause
from tests.hil_sim.device_bench import HOST, OTHER, Bench, expect_refusal


def test_a_silent_host_trips_the_device(real: Bench) -> None:
    real.stream()
    real.drive(1.0)
    for k in range(40):
        real.pass_time(0.1)
        real.exchange(k)
    assert real.status(reg.STATUS_CAUSE) == TripCause.NONE
    real.pass_time(0.48)
    assert real.status(reg.STATUS_OUTPUTS) >> 128 == 205
    real.pass_time(0.1)
    assert real.status(reg.STATUS_CAUSE) == TripCause.WATCHDOG
    assert real.status(reg.STATUS_OUTPUTS) == 0
    tripped = real.status(reg.STATUS_TRIP_TICK)
    assert 4500 <= tripped <= 4560
    piston = real.plant.piston[0]
    real.pass_time(0.5)
    assert real.plant.piston[0] == piston


def test_a_host_that_repeats_its_heartbeat_is_not_alive(real: Bench) -> None:
    real.stream()
    real.drive(1.0)
    for _ in range(30):
        real.pass_time(0.02)
        real.write(reg.CONTROL_HEARTBEAT, 77)
    assert real.status(reg.STATUS_CAUSE) == TripCause.WATCHDOG


def test_the_devices_own_stall_is_not_the_hosts_silence(real: Bench) -> None:
    real.stream()
    real.drive(1.0)
    real.now += 2.0  # the whole machine stood still; the host's requests wait in the socket
    real.device.poll()
    assert real.status(reg.STATUS_CAUSE) == TripCause.NONE
    real.exchange()
    real.pass_time(0.6)
    assert real.status(reg.STATUS_CAUSE) == TripCause.WATCHDOG


def test_an_idle_device_has_nothing_to_trip_but_gives_control_up(real: Bench) -> None:
    real.write(reg.CONTROL_WATCHDOG, 200)
    expect_refusal(Refusal.NOT_IN_CONTROL, real.write, reg.CONTROL_STREAM, 0, client=OTHER)
    real.pass_time(0.3)
    assert real.status(reg.STATUS_CAUSE) == TripCause.NONE
    real.write(reg.CONTROL_STREAM, 0, client=OTHER)


def test_a_trip_latches_until_reset(real: Bench) -> None:
    real.drive(1.0)
    real.pass_time(0.6)
    expect_refusal(Refusal.TRIPPED, real.drive, 1.0)
    real.stream()
    assert real.exchange()[0].status & Status.TRIPPED
    expect_refusal(Refusal.OUT_OF_RANGE, real.write, reg.CONTROL_RESET, 1)
    expect_refusal(Refusal.TRIPPED, real.drive, 1.0)
    real.write(reg.CONTROL_RESET, reg.RESET_KEY)
    assert real.status(reg.STATUS_OUTPUTS) == 0
    real.drive(1.0)
    real.pass_time(0.1)
    assert real.status(reg.STATUS_OUTPUTS) != 0


def test_a_lost_connection_zeroes_at_once_and_lets_virtual_time_settle(virtual: Bench) -> None:
    virtual.stream()
    virtual.drive(1.0)
    virtual.exchange()
    virtual.device.disconnected(HOST)
    assert virtual.status(reg.STATUS_CAUSE) == TripCause.HOST_LOST
    assert virtual.status(reg.STATUS_OUTPUTS) == 0
    assert virtual.device.tick == 10 + 200
    # The plant was driven for one block and not one sample longer.
    assert virtual.plant.piston[0] == pytest.approx(10 * 0.02 * 205 * 10 / 2047 / 1000)
    assert not virtual.status(reg.STATUS_FLAGS) & (Status.STREAMING | Status.CONTROLLED)


def test_a_bystander_may_leave_without_a_stir(virtual: Bench) -> None:
    virtual.stream()
    virtual.drive(1.0)
    virtual.device.disconnected(OTHER)
    assert virtual.status(reg.STATUS_CAUSE) == TripCause.NONE


def test_a_host_that_cleared_up_leaves_no_trip(virtual: Bench) -> None:
    virtual.stream()
    virtual.drive(1.0)
    virtual.write(reg.CONTROL_ZERO, 1)
    virtual.write(reg.CONTROL_STREAM, reg.STREAM_STOP)
    virtual.device.disconnected(HOST)
    assert virtual.status(reg.STATUS_CAUSE) == TripCause.NONE


def test_zeroing_is_for_everyone_and_nothing_staged_survives_it(virtual: Bench) -> None:
    virtual.stream()
    virtual.drive(1.0)
    virtual.law(2, bias=1.0, limit=2.0)
    virtual.write(reg.CONTROL_ZERO, 1, client=OTHER)
    virtual.write(reg.CONTROL_APPLY, reg.APPLY)
    assert not virtual.exchange()[1].any()


def test_virtual_hosts_may_think_for_seconds_but_not_for_ever(virtual: Bench) -> None:
    virtual.stream()
    virtual.drive(1.0)
    virtual.exchange()
    virtual.pass_time(9.9)
    assert virtual.status(reg.STATUS_CAUSE) == TripCause.NONE
    virtual.pass_time(0.2)
    assert virtual.status(reg.STATUS_CAUSE) == TripCause.WATCHDOG
    headers = [virtual.exchange(k)[0] for k in range(20)]
    assert [h.tick for h in headers] == list(range(10, 210, 10))  # settling is streamed, too
    assert all(h.status & Status.TRIPPED for h in headers)


class BrokenPlant:
    tick = 0

    def advance(self, ticks: int, laws: Sequence[Any]) -> Any:
        raise FloatingPointError("step too large")


@pytest.mark.parametrize("realtime", [False, True])
def test_a_plant_that_fails_is_a_fault_no_reset_clears(realtime: bool) -> None:
    bench = Bench(realtime=realtime, plant=BrokenPlant())
    bench.write(reg.CONTROL_WATCHDOG, 500)
    bench.now += 0.05
    bench.device.poll()
    if not realtime:
        bench.stream()
        expect_refusal(Refusal.FAULT, bench.exchange)
    assert bench.status(reg.STATUS_CAUSE) == TripCause.FAULT
    expect_refusal(Refusal.FAULT, bench.write, reg.CONTROL_RESET, reg.RESET_KEY)
