"""The sample clock, laws, limits and watchdog of a bench that has none of these, in fake time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import OFF, DeviceError, DeviceLost, OutputLaw, SampleBlock
from drivers.modbus_rtu import ModbusRtuDriver
from drivers.modbus_tcp import ModbusTcpDriver
from drivers.polled import PolledDriver
from rig.bench.session import Bench
from rig.model.parse import InputError
from rig.model.trips import SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from tests.drivers.polled_bench import FakeClock, FakeModule, polled_bench
from tests.hil_sim.integrator import SPEED_PER_VOLT

PISTON_1, COMMAND_1 = 1, 10


def stack(blocks: list[SampleBlock]) -> np.ndarray:
    return np.vstack([block.data for block in blocks])


def started(**options: object) -> tuple[PolledDriver, FakeModule, FakeClock]:
    driver, module, clock = polled_bench(**options)  # type: ignore[arg-type]
    driver.connect()
    driver.start()
    return driver, module, clock


def test_the_interface_says_who_keeps_the_time() -> None:
    assert PolledDriver.host_timed
    assert not ModbusTcpDriver.host_timed
    assert not ModbusRtuDriver.host_timed


def test_connecting_zeroes_the_outputs_and_tells_what_the_rig_needs() -> None:
    driver, module, _ = polled_bench()
    info = driver.connect()
    assert (info.identity, info.joints, info.channels) == ("a module of the test", 2, 10)
    assert (info.sample_rate, info.block_samples, info.virtual_time) == (100.0, 5, False)
    assert module.written
    assert all((volts == 0.0).all() for _, volts in module.written)


def test_ticks_are_paced_by_the_clock_and_blocks_follow_each_other() -> None:
    driver, _, clock = started()
    begun = clock.now
    blocks = [driver.read_block() for _ in range(8)]
    assert [block.sequence for block in blocks] == list(range(8))
    assert [block.tick for block in blocks] == [1 + 5 * k for k in range(8)]
    assert clock.now - begun == pytest.approx(0.40)
    assert clock.naps == pytest.approx([0.01] * 40)
    read_at = np.concatenate([block.read_at for block in blocks if block.read_at is not None])
    assert read_at == pytest.approx(0.01 * np.arange(1, 41))
    assert (driver.timing.served, driver.timing.late, driver.timing.missing) == (40, 0, 0)


def test_waveform_position_loop_bias_and_limit_are_the_law_of_the_interface() -> None:
    driver, module, _ = started()
    driver.read_block()
    wave = 2.0 * np.sin(2 * np.pi * np.arange(30) / 30)
    driver.upload(0, wave)
    laws = [
        OutputLaw(gain=0.5, bias=0.25, position_gain=40.0, setpoint=0.01, limit=1.1),
        OutputLaw(bias=-3.0, limit=0.75),
    ]
    tick = driver.apply(laws, restart=True)
    assert tick == 6
    blocks = [driver.read_block() for _ in range(20)]
    assert blocks[0].tick == tick
    data = stack(blocks)
    k = np.arange(len(data))
    expected = np.clip(0.5 * wave[k % 30] + 0.25 + 40.0 * (0.01 - data[:, PISTON_1]), -1.1, 1.1)
    assert data[:, COMMAND_1] == pytest.approx(expected)
    assert np.all(data[:, COMMAND_1 + 1] == -0.75)
    moved = SPEED_PER_VOLT * 0.01 * np.concatenate([[0.0], np.cumsum(data[:-1, COMMAND_1])])
    assert data[:, PISTON_1] - data[0, PISTON_1] == pytest.approx(moved)
    assert max(abs(volts[0]) for _, volts in module.written) == pytest.approx(1.1)


def test_new_laws_without_restart_let_the_waveform_run_on() -> None:
    driver, _, _ = started()
    driver.upload(0, np.arange(8) / 10)
    first = driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    driver.read_block()
    driver.apply([OutputLaw(gain=2.0, limit=2.0), OFF])
    block = driver.read_block()
    phase = (np.arange(block.tick, block.tick + 5) - first) % 8
    assert block.data[:, COMMAND_1] == pytest.approx(2.0 * phase / 10)


def test_uneven_wakings_are_interpolated_onto_the_grid() -> None:
    driver, module, clock = polled_bench()
    rng = np.random.default_rng(3)
    omega = 2 * np.pi * 1.5
    module.signal = lambda t: np.full(10, 0.02 * np.sin(omega * (t - 1000.0)))
    clock.late = lambda _: rng.uniform(0.0, 0.004)
    driver.connect()
    driver.start()
    blocks = [driver.read_block() for _ in range(40)]
    ticks = np.arange(blocks[0].tick, blocks[0].tick + 200)
    data = stack(blocks)
    error = np.abs(data[:, PISTON_1] - 0.02 * np.sin(omega * ticks / 100.0))
    assert error.max() <= 0.02 * (omega * 0.015) ** 2 / 8
    read_at = np.concatenate([block.read_at for block in blocks if block.read_at is not None])
    off = np.abs(0.02 * np.sin(omega * read_at) - 0.02 * np.sin(omega * ticks / 100.0))
    assert error.max() < 0.3 * off.max()
    assert np.all(read_at >= ticks / 100.0 - 1e-9)
    assert driver.timing.missing == 0
    assert 0.0 < driver.timing.worst <= 0.004


@given(
    late=st.lists(st.floats(0.0, 0.03), min_size=1, max_size=30),
    reading=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=30),
    pauses=st.lists(st.floats(0.0, 0.7), min_size=1, max_size=12),
)
def test_however_late_the_host_no_row_is_wrong_or_uncounted(
    late: list[float], reading: list[float], pauses: list[float]
) -> None:
    """What is linear in time must come out exactly, whatever the times it was read at."""
    driver, module, clock = polled_bench()
    driver.connect()
    origin = clock.now
    reads = iter(range(1_000_000))
    clock.late = lambda nap: late[nap % len(late)]

    def signal(_: float) -> np.ndarray:
        half = reading[next(reads) % len(reading)] / 2
        clock.pass_(half)
        values = 1e-3 * np.arange(10) + 2e-3 * (clock.now - origin)
        clock.pass_(half)
        return values

    module.signal = signal
    driver.start()
    wave = np.arange(7) / 7
    driver.upload(0, wave)
    start = driver.apply([OutputLaw(gain=2.0, limit=1.5), OFF], restart=True)
    seen: list[SampleBlock] = []
    try:
        for pause in pauses:
            seen.append(driver.read_block())
            clock.pass_(pause)
    except DeviceError as error:
        assert "lower the rig's sample_rate" in str(error)  # noqa: PT017
        assert (module.volts == 0.0).all()
    rows = 0
    for block in seen:
        ticks = np.arange(block.tick, block.tick + len(block.data))
        expected = 1e-3 * np.arange(10) + 2e-3 * ticks[:, None] / 100.0
        assert block.data[:, :10] == pytest.approx(expected, abs=1e-7)
        assert block.read_at is not None
        own = np.isfinite(block.read_at)
        played = np.minimum(2.0 * wave[(ticks - start) % 7], 1.5)
        if not block.tripped:
            assert block.data[own, COMMAND_1] == pytest.approx(played[own])
        rows += len(block.data)
    for before, after in pairwise(seen):
        assert after.tick >= before.tick + len(before.data)
        gap = after.tick > before.tick + len(before.data)
        assert after.sequence == before.sequence + (2 if gap else 1)
        assert before.tripped <= after.tripped
    if seen:
        span = seen[-1].tick + len(seen[-1].data) - seen[0].tick
        assert 0 <= span - rows <= driver.timing.missing


def test_lateness_of_more_than_half_a_period_is_counted() -> None:
    driver, _, clock = started()
    clock.late = lambda nap: 0.006 if nap == 3 else 0.0
    clock.naps.clear()
    blocks = [driver.read_block() for _ in range(2)]
    assert driver.timing.late == 1
    assert driver.timing.worst == pytest.approx(0.006)
    # 1.6 periods after the sample before: its own tick is missing, the next one is there.
    assert driver.timing.missing == 1
    assert [(block.tick, len(block.data)) for block in blocks] == [(1, 2), (4, 5)]


def test_a_tick_left_out_between_two_near_samples_holds_the_voltage_of_before() -> None:
    driver, module, clock = started()
    driver.upload(0, np.arange(40) / 100)
    driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    takes = iter([0.008, 0.008, 0.008, 0.008, 0.011])
    module.before_read = lambda: clock.pass_(next(takes, 0.0))
    driver.read_block()
    clock.pass_(0.009)
    # Tick 5 was read at 5.55 periods, the next tick served is 7: 6 lies between the two.
    block = driver.read_block()
    assert (block.tick, driver.timing.missing) == (6, 0)
    assert block.read_at is not None
    assert np.isnan(block.read_at).tolist() == [True, False, False, False, False]
    assert block.data[:3, COMMAND_1] == pytest.approx([0.04, 0.06, 0.07])


def test_a_stall_is_a_gap_and_the_waveform_keeps_its_phase() -> None:
    driver, module, clock = started()
    driver.upload(0, np.arange(40) / 100)
    start = driver.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
    driver.read_block()
    clock.pass_(0.095)
    before = len(module.written)
    block = driver.read_block()
    ticks = np.arange(block.tick, block.tick + len(block.data))
    # Ticks 6 to 14 passed; the sample of 14, taken in the middle of it, starts the grid anew.
    assert block.tick == 15
    assert driver.timing.missing == 9
    assert len(module.written) - before == 6
    assert block.data[:, COMMAND_1] == pytest.approx((ticks - start) / 100)
    assert not block.tripped


def test_rows_before_a_gap_come_as_a_shorter_block() -> None:
    driver, module, clock = started()
    reads = iter(range(100))
    module.before_read = lambda: clock.pass_(0.03 if next(reads) == 3 else 0.0)
    first, second = driver.read_block(), driver.read_block()
    assert (first.tick, len(first.data)) == (1, 3)
    assert second.tick > 4
    assert second.sequence == 2  # what is missing counts as a block
    assert driver.timing.missing == second.tick - 4


def test_a_host_silent_for_longer_than_the_watchdog_finds_its_outputs_zeroed() -> None:
    driver, module, clock = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    assert module.volts[0] == 1.0
    clock.pass_(0.6)
    before = len(module.written)
    block = driver.read_block()
    assert block.tripped
    assert all((volts == 0.0).all() for _, volts in module.written[before:])
    assert np.all(block.data[:, COMMAND_1:] == 0.0)
    cause = driver.trip_cause()
    assert cause is not None
    assert "did not serve the outputs for 0.6 s, allowed 0.5 s" in cause
    with pytest.raises(DeviceError, match=r"tripped: watchdog: .* then reset it"):
        driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.apply([OFF, OFF])
    driver.reset()
    assert driver.trip_cause() is None
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    assert not driver.read_block().tripped


@pytest.mark.parametrize("seconds", [0.7, 5.0037])
def test_a_reading_that_takes_longer_than_the_watchdog_trips_before_anything_is_put_out(
    seconds: float,
) -> None:
    driver, module, clock = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    slow = iter([seconds])
    module.before_read = lambda: clock.pass_(next(slow, 0.0))
    before = len(module.written)
    assert driver.read_block().tripped
    assert all((volts == 0.0).all() for _, volts in module.written[before:])


def test_after_a_silence_zero_is_written_before_anything_is_read() -> None:
    driver, module, clock = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    clock.pass_(0.6)
    module.before_read = raising(ConnectionResetError("reset"))
    before = len(module.written)
    with pytest.raises(DeviceLost):
        driver.read_block()
    at, volts = module.written[before]
    assert at == clock.now
    assert (volts == 0.0).all()
    assert driver.trip_cause() is not None


def test_the_modules_own_shorter_watchdog_is_what_counts() -> None:
    driver, _, clock = started(watchdog=0.1)
    driver.read_block()
    clock.pass_(0.2)
    assert driver.read_block().tripped


def test_zeroing_acts_at_once_and_stays() -> None:
    driver, module, _ = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    naps = len(module.clock.naps)
    driver.zero_outputs()
    assert (module.volts == 0.0).all()
    assert len(module.clock.naps) == naps
    assert np.all(driver.read_block().data[:, COMMAND_1:] == 0.0)


def test_stopping_and_closing_leave_zero_outputs() -> None:
    driver, module, _ = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    driver.stop()
    assert (module.volts == 0.0).all()
    with pytest.raises(DeviceError, match="not started"):
        driver.read_block()
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    driver.close()
    assert (module.volts == 0.0).all()
    assert module.calls[-1] == "close"
    driver.close()
    with pytest.raises(DeviceLost, match="closed"):
        driver.start()


def test_closing_tells_how_well_the_clock_was_kept(caplog: pytest.LogCaptureFixture) -> None:
    driver, _, clock = started()
    clock.late = lambda nap: 0.006 if nap == 3 else 0.0
    driver.read_block()
    with caplog.at_level(logging.INFO):
        driver.close()
    assert "4 ticks served, 1 late by more than half a period, worst 6 ms; 1 missing" in caplog.text


def test_the_clock_does_not_go_back_between_two_streams() -> None:
    driver, _, clock = started()
    last = driver.read_block().tick + 5
    driver.stop()
    clock.pass_(1.0)
    driver.start()
    again = driver.read_block()
    assert again.sequence == 0
    assert again.tick >= last + 100
    assert not again.tripped
    driver.close()
    driver.connect()
    driver.start()
    assert driver.read_block().tick > again.tick


def raising(error: Exception) -> Callable[[], None]:
    def call() -> None:
        raise error

    return call


@pytest.mark.parametrize(
    ("error", "expected", "said"),
    [
        (ConnectionResetError("reset by peer"), DeviceLost, "is gone: reset by peer"),
        (TimeoutError("timed out"), DeviceLost, "timed out"),
        (DeviceLost("silent"), DeviceLost, "silent"),
        (ZeroDivisionError("division"), DeviceError, "failed: ZeroDivisionError: division"),
    ],
)
def test_whatever_a_reading_raises_is_a_declared_error_with_outputs_at_zero(
    error: Exception, expected: type[Exception], said: str
) -> None:
    driver, module, _ = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    module.before_read = raising(error)
    with pytest.raises(expected, match=said):
        driver.read_block()
    assert (module.volts == 0.0).all()
    with pytest.raises(expected, match=said if expected is DeviceLost else "not started"):
        driver.read_block()


def test_a_device_whose_link_broke_is_opened_again_to_be_zeroed() -> None:
    driver, module, _ = started()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    module.before_write = raising(BrokenPipeError("broken"))
    with pytest.raises(DeviceLost):
        driver.read_block()
    assert module.volts[0] == 1.0
    with pytest.raises(DeviceLost):
        driver.zero_outputs()
    module.before_write = lambda: None
    module.calls.clear()
    driver.zero_outputs()
    assert module.calls == ["close", "open"]
    assert (module.volts == 0.0).all()


def test_a_sample_of_another_size_is_an_error() -> None:
    driver, module, _ = started()
    module.signal = lambda _: np.zeros(9)
    with pytest.raises(DeviceError, match=r"shape \(9,\) came, expected \(10,\)"):
        driver.read_block()


def test_a_position_that_is_no_number_puts_out_zero() -> None:
    driver, module, _ = started()
    driver.apply([OutputLaw(bias=1.0, position_gain=10.0, limit=2.0), OutputLaw(bias=1, limit=2)])
    values = np.full(10, 1e-3)
    values[PISTON_1] = np.nan
    module.signal = lambda _: values
    block = driver.read_block()
    assert np.isnan(block.data[:, PISTON_1]).all()
    assert module.volts.tolist() == [0.0, 1.0]


def test_samples_at_or_beyond_the_ends_of_a_sensor_are_marked() -> None:
    driver, module, _ = started()
    values = np.full(10, 1e-3)
    values[0], values[PISTON_1], values[2] = -2.0, 41e-3, 10e6 - 1.0
    module.signal = lambda _: values
    driver.read_block()
    block = driver.read_block()
    assert np.flatnonzero(block.saturated.all(axis=0)).tolist() == [0, PISTON_1]
    assert block.saturated.any(axis=0).sum() == 2


def test_a_module_too_slow_for_the_rig_is_refused_with_the_rate_it_can_do() -> None:
    driver, module, clock = polled_bench()
    module.before_read = lambda: clock.pass_(0.02)
    with pytest.raises(DeviceError, match=r"takes 20 ms, .* 100 Hz leaves 10 ms; lower it to 25 "):
        driver.connect()
    assert module.calls == ["open", "close"]


def test_a_module_that_becomes_too_slow_ends_in_an_error_not_in_silence() -> None:
    driver, module, clock = started()
    module.before_read = lambda: clock.pass_(0.0171)
    with pytest.raises(DeviceError, match=r"within 1.5 periods of 100 Hz; lower"):  # noqa: PT012
        for _ in range(10_000):
            driver.read_block()


def test_a_module_without_a_watchdog_is_refused_or_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pytest.raises(InputError, match=r"wire: zero_by: .*accept_no_watchdog: true"):
        polled_bench(watchdog=None)
    driver, _, _ = polled_bench(watchdog=None, accept_no_watchdog=True)
    with caplog.at_level(logging.WARNING):
        driver.connect()
    assert "does not zero its outputs by itself" in caplog.text


def test_watchdogs_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"zeroes its outputs after 2 s, wire.watchdog promises"):
        polled_bench(watchdog=2.0)
    with pytest.raises(InputError, match=r"0.02 s is shorter than 3 sample periods"):
        polled_bench(watchdog=0.02)
    rig = load_rig("electric-2dof")
    with pytest.raises(InputError, match="electric"):
        PolledDriver(rig.wire, rig, FakeModule(rig, FakeClock()))


@pytest.mark.parametrize(
    ("laws", "said"),
    [
        ([OFF], "1 laws for a rig of 2"),
        ([OutputLaw(gain=float("nan")), OFF], "not finite"),
        ([OFF, OutputLaw(limit=11.0)], r"law of joint 2 has the limit 11 V, expected 0 to 10"),
        ([OutputLaw(limit=-1.0), OFF], "limit -1 V"),
    ],
)
def test_laws_that_cannot_be_are_refused(laws: list[OutputLaw], said: str) -> None:
    driver, _, _ = started()
    with pytest.raises(DeviceError, match=said):
        driver.apply(laws)


def test_waveforms_that_cannot_be_are_refused() -> None:
    driver, _, _ = started()
    for joint, wave, said in (
        (2, [0.0], "no joint 3"),
        (0, [], "is empty"),
        (0, [0.0, 10.5], "sample 1 is 10.5 V"),
        (1, [float("nan")], "sample 0 is nan V"),
    ):
        with pytest.raises(DeviceError, match=said):
            driver.upload(joint, np.array(wave))


def test_a_bench_runs_and_records_a_second_of_it(tmp_path: Path) -> None:
    driver, module, clock = polled_bench()
    recorder = Recorder(tmp_path / "run", module.rig)
    with Bench(module.rig, driver, recorder, clock=clock, signals=False) as bench:
        bench.upload(0, 0.5 * np.sin(2 * np.pi * np.arange(50) / 50))
        first = bench.apply([OutputLaw(gain=1.0, limit=2.0), OFF], restart=True)
        with bench.record(step="sine", start_tick=first, ticks=100):
            begun = clock.now
            data = bench.run_for(1.0)
    assert clock.now - begun == pytest.approx(1.0)
    assert data.shape == (100, 12)
    assert bench.lost_samples == 0
    played = 0.5 * np.sin(2 * np.pi * np.arange(100) / 50)
    assert data[:, COMMAND_1] == pytest.approx(played)
    assert (module.volts == 0.0).all()
    run = load_run(tmp_path / "run")
    (record,) = run.records
    assert record.channels["command_1"] == pytest.approx(played)
    moved = SPEED_PER_VOLT * 0.01 * np.cumsum(played)[:-1]
    assert record.channels["piston_1"][1:] - record.channels["piston_1"][0] == pytest.approx(
        moved, abs=1e-12
    )


def test_a_late_host_records_short_blocks_and_counts_what_is_lost(tmp_path: Path) -> None:
    driver, module, clock = polled_bench()
    clock.late = lambda nap: 0.018 if nap % 17 == 0 else 0.0
    recorder = Recorder(tmp_path / "run", module.rig)
    with Bench(module.rig, driver, recorder, clock=clock, signals=False) as bench:
        data = bench.run_for(1.0)
    assert bench.lost_samples == driver.timing.missing
    assert bench.lost_samples == 2 * (len(clock.naps) // 17)
    assert 100 <= len(data) + bench.lost_samples < 110


def test_a_bench_trips_on_a_stall_of_its_own_process() -> None:
    driver, module, clock = polled_bench()
    with (  # noqa: PT012
        pytest.raises(SafetyTrip, match="sample gap"),
        Bench(module.rig, driver, clock=clock, signals=False) as bench,
    ):
        bench.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
        bench.run_for(0.2)
        clock.pass_(0.7)
        bench.exchange()
    assert (module.volts == 0.0).all()
    driver.connect()
    assert driver.trip_cause() is not None
