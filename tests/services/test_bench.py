"""Whatever ends a session with a device, its outputs go to zero before anything else happens."""

from __future__ import annotations

import logging
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DeviceError, DeviceInfo, DeviceLost, OutputLaw, SampleBlock
from rig.bench.guard import EXCITED, FREE, JointRole
from rig.bench.latch import reset_bench
from rig.bench.session import Bench
from rig.model.trips import Latched, OperatorStop, SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.services.fake_driver import FakeDriver

RIG = load_rig("shinshu-2dof")
MOVE = [OutputLaw(bias=1.0, limit=2.0), OutputLaw()]


class Told:
    """A recorder's double that writes into the driver's log, to see what came before what."""

    def __init__(self, driver: FakeDriver) -> None:
        self.folder = Path("unused")
        self.driver = driver
        self.is_open = True

    def time_of(self, tick: int) -> float:
        return tick / RIG.sample_rate

    def __getattr__(self, name: str):
        def told(*_: object, **__: object) -> int:
            self.driver.calls.append(f"recorder.{name}")
            return 1

        return told


def pressure_at(tick: int, value: float = 9.5e6):
    def spoil(block: SampleBlock) -> SampleBlock:
        if not block.tick <= tick < block.tick + len(block.data):
            return block
        data = block.data.copy()
        data[tick - block.tick, RIG.recorded.index("cap_pressure_1")] = value
        return replace(block, data=data)

    return spoil


def test_a_trip_zeroes_the_outputs_before_anything_is_written(tmp_path: Path) -> None:
    driver = FakeDriver(RIG, spoil=pressure_at(34))
    told = Told(driver)
    with pytest.raises(SafetyTrip) as caught, Bench(RIG, driver, told) as bench:  # noqa: PT012
        bench.apply(MOVE)
        driver.calls.clear()
        bench.run_for(1.0)
    trip = caught.value
    assert (trip.limit, trip.value, trip.joint, trip.channel) == (
        "pressure", 9.5e6, 1, "cap_pressure_1",
    )  # fmt: skip
    assert (trip.device_time, trip.allowed) == (0.034, RIG.joints[0].limits.pressure)
    assert driver.calls[:3] == ["recorder.append"] * 3
    assert driver.calls[3:6] == ["zero", "recorder.append", "recorder.event"]
    assert driver.calls[-3:] == ["stop", "close", "recorder.finish"]


def test_a_device_that_tripped_earlier_is_left_alone_until_a_person_resets(
    tmp_path: Path,
) -> None:
    driver = FakeDriver(RIG)
    driver.latched = "host fell silent"
    with pytest.raises(Latched, match="bramah reset"), Bench(RIG, driver, signals=False):
        pytest.fail("a run began on a tripped device")
    driver.reset()
    with Bench(RIG, driver, signals=False) as bench:
        bench.exchange()


def test_a_trip_is_in_the_run_with_its_block_and_the_state_is_tripped(tmp_path: Path) -> None:
    driver = FakeDriver(RIG, spoil=pressure_at(34))
    recorder = Recorder(tmp_path / "run", RIG)
    with pytest.raises(SafetyTrip), Bench(RIG, driver, recorder) as bench:  # noqa: PT012
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(1.0)
    assert (tmp_path / "run" / "state").read_text() == "tripped\n"
    run = load_run(tmp_path / "run", partial=True)
    assert run.state == "tripped"
    assert run.records[0].samples == 30
    assert run.records[0].channels["cap_pressure_1"][24] == 9.5e6
    events = {e["event"]: e for e in read_events(tmp_path / "run")}
    assert events["trip"]["tick"] == 34
    assert "9.5 MPa" in events["trip"]["message"]
    assert events["end"]["state"] == "tripped"


def test_a_trip_latches_until_it_is_reset(caplog: pytest.LogCaptureFixture) -> None:
    driver = FakeDriver(RIG, spoil=pressure_at(14))
    with Bench(RIG, driver) as bench:
        with pytest.raises(SafetyTrip) as first:
            bench.run_for(1.0)
        driver.calls.clear()
        for attempt in (
            bench.exchange,
            lambda: bench.apply(MOVE),
            lambda: bench.upload(0, np.ones(2)),
        ):
            with pytest.raises(SafetyTrip) as again:
                attempt()
            assert again.value is first.value
        assert set(driver.calls) == {"zero"}
    with pytest.raises(Latched, match=r"9.5 MPa.*bramah reset .*--reason"), Bench(RIG, driver):
        pytest.fail("a run began on a bench that had tripped")
    assert reset_bench(RIG, driver, "sensor replaced").startswith("safety trip: limit 'pressure'")
    assert driver.calls[-3:] == ["connect", "reset", "close"]
    with Bench(RIG, driver) as bench:
        bench.apply(MOVE)
        assert len(bench.run_for(0.1)) == 100


def test_roles_decide_which_piston_limits_hold() -> None:
    driver = FakeDriver(RIG)  # pistons move by +-30 mm
    with Bench(RIG, driver) as bench:
        bench.guard([FREE, EXCITED])
        bench.run_for(1.0)
        bench.guard([JointRole(locked_at=0.0, tolerance=0.02), EXCITED])
        with pytest.raises(SafetyTrip, match=r"'lock', piston_1 of joint 1 \(boom\)"):
            bench.run_for(1.0)


def test_laws_are_bounded_by_the_joints_command_limit_and_must_be_finite() -> None:
    driver = FakeDriver(RIG)
    with Bench(RIG, driver) as bench:
        bench.apply([OutputLaw(bias=20.0, limit=10.0), OutputLaw(limit=-1.0)])
        assert [law.limit for law in driver.laws] == [4.0, 0.0]
        taken = bench.run_for(0.01)
        assert taken[:, -2].max() == 4.0
        for wrong in ([OutputLaw()], [OutputLaw(gain=np.nan), OutputLaw()]):
            with pytest.raises(ValueError, match=r"joints|finite"):
                bench.apply(wrong)
        with pytest.raises(ValueError, match="finite"):
            bench.upload(0, np.array([1.0, np.inf]))


@pytest.mark.parametrize("error", [DeviceLost("gone"), DeviceError("garbage"), RuntimeError("bug")])
def test_a_device_that_fails_is_zeroed_and_the_failure_passes_through(
    tmp_path: Path, error: Exception
) -> None:
    def fail(sequence: int) -> None:
        if sequence == 5:
            driver.calls.append("failed")
            raise error

    driver = FakeDriver(RIG, before_block=fail)
    recorder = Recorder(tmp_path / "run", RIG)
    with pytest.raises(type(error), match=str(error)), Bench(RIG, driver, recorder) as bench:  # noqa: PT012
        bench.apply(MOVE)
        with bench.record(step="s", start_tick=0):
            bench.run_for(1.0)
    assert driver.calls[driver.calls.index("failed") + 1] == "zero"
    run = load_run(tmp_path / "run", partial=True)
    assert (run.state, run.records[0].samples) == ("aborted", 50)
    source = "device: " if isinstance(error, DeviceError) else ""
    assert read_events(tmp_path / "run")[-1]["message"] == f"{source}{error}"


def test_a_device_that_is_gone_for_good_is_tried_but_not_waited_for(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def die(sequence: int) -> None:
        driver.dead = sequence >= 3

    driver = FakeDriver(RIG, before_block=die)
    with caplog.at_level(logging.ERROR), pytest.raises(DeviceLost), Bench(RIG, driver) as bench:
        bench.run_for(1.0)
    assert driver.calls[-1] == "close"
    assert "does not answer" in caplog.text


def test_a_device_of_another_rig_is_refused_at_zero(tmp_path: Path) -> None:
    driver = FakeDriver(RIG)
    driver.info = DeviceInfo("other", 3, 14, 1000.0, 10, True)
    with pytest.raises(DeviceError, match="has 3 joints, rig 'shinshu-2dof' has 2"):
        Bench(RIG, driver, Recorder(tmp_path / "run", RIG)).__enter__()
    assert driver.calls == ["connect", "zero", "zero", "zero", "stop", "close"]
    assert not (tmp_path / "run").exists()


def test_no_device_leaves_no_folder_behind(tmp_path: Path) -> None:
    driver = FakeDriver(RIG)
    driver.dead = True
    with pytest.raises(DeviceLost), Bench(RIG, driver, Recorder(tmp_path / "run", RIG)):
        raise AssertionError
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda b: replace(b, tick=b.tick - 10) if b.sequence == 4 else b, "out of order"),
        (lambda b: replace(b, data=b.data[:, :5]) if b.sequence == 4 else b, "shape"),
        (lambda b: replace(b, data=b.data[:0]) if b.sequence == 4 else b, "shape"),
    ],
)
def test_blocks_that_cannot_be_are_an_error_of_the_device(spoil, said: str) -> None:
    driver = FakeDriver(RIG, spoil=spoil)
    with pytest.raises(DeviceError, match=said), Bench(RIG, driver) as bench:  # noqa: PT012
        bench.apply(MOVE)
        bench.run_for(1.0)
    assert driver.laws == [OutputLaw()] * 2


def test_a_device_that_zeroed_itself_trips_the_run() -> None:
    driver = FakeDriver(RIG, spoil=lambda b: replace(b, tripped=b.sequence == 4))
    with pytest.raises(SafetyTrip, match="device watchdog or fault"), Bench(RIG, driver) as bench:
        bench.run_for(1.0)


def test_stale_data_trips_in_real_time_and_never_in_virtual_time() -> None:
    now = [0.0]

    def hang(sequence: int) -> None:
        now[0] += 0.7 if sequence == 6 else 0.01

    for virtual in (True, False):
        driver = FakeDriver(RIG, virtual=virtual, before_block=hang)
        with Bench(RIG, driver, clock=lambda: now[0]) as bench:
            if virtual:
                bench.run_for(0.2)
            else:
                with pytest.raises(SafetyTrip, match=r"'stale data', the bench: 0.6[89]\d* s"):
                    bench.run_for(0.2)


def test_a_long_gap_trips_and_a_short_one_is_counted() -> None:
    lost = {5}
    driver = FakeDriver(RIG, spoil=lambda b: None if b.sequence in lost else b)
    with Bench(RIG, driver) as bench:
        bench.run_for(0.1)
        assert bench.lost_samples == 10
        lost |= set(range(20, 40))
        with pytest.raises(SafetyTrip, match=r"'sample gap', the bench: 0.2 s"):
            bench.run_for(1.0)


def test_whoever_raises_while_a_record_is_open_the_outputs_are_zero_before_it_is_closed() -> None:
    driver = FakeDriver(RIG)
    with pytest.raises(ZeroDivisionError), Bench(RIG, driver, Told(driver)) as bench:  # noqa: PT012
        bench.exchange()
        bench.apply(MOVE)
        with bench.record(step="s"):
            driver.calls.clear()
            raise ZeroDivisionError
    assert driver.calls[:2] == ["zero", "recorder.end_record"]


def test_the_next_block_is_asked_for_ahead_only_where_it_is_surely_wanted() -> None:
    class Asking(FakeDriver):
        def ask_ahead(self) -> None:
            self.calls.append(f"ask ahead of {self.tick}")

    driver = Asking(RIG)
    with Bench(RIG, driver) as bench:
        driver.calls.clear()
        bench.exchange()
        bench.run_for(0.025)
        assert driver.calls == ["ask ahead of 20", "ask ahead of 30"]


def test_a_watcher_that_raises_finds_the_outputs_at_zero() -> None:
    driver = FakeDriver(RIG)

    def watch(block: SampleBlock) -> None:
        raise ZeroDivisionError

    with Bench(RIG, driver) as bench:
        bench.apply(MOVE)
        with pytest.raises(ZeroDivisionError):
            bench.run_for(0.1, watch)
        assert driver.calls[-1] == "zero"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_at_the_next_exchange_and_the_handlers_come_back(
    tmp_path: Path, number: signal.Signals
) -> None:
    before = signal.getsignal(number)

    def stop(sequence: int) -> None:
        if sequence == 7:
            os.kill(os.getpid(), number)

    driver = FakeDriver(RIG, before_block=stop)
    with pytest.raises(OperatorStop), Bench(RIG, driver, Recorder(tmp_path / "r", RIG)) as bench:  # noqa: PT012
        bench.apply(MOVE)
        with bench.record(step="s", start_tick=0):
            bench.run_for(1.0)
    assert driver.calls[3:] == ["apply", "zero", "zero", "zero", "zero", "stop", "close"]
    assert driver.tick == 80 + 2000
    assert signal.getsignal(number) is before
    run = load_run(tmp_path / "r", partial=True)
    assert (run.state, run.records[0].samples) == ("aborted", 80)


def test_ctrl_c_at_the_very_end_keeps_the_run_and_still_ends_the_program(tmp_path: Path) -> None:
    driver = FakeDriver(RIG)
    with pytest.raises(OperatorStop), Bench(RIG, driver, Recorder(tmp_path / "r", RIG)) as bench:  # noqa: PT012
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(0.1)
        os.kill(os.getpid(), signal.SIGINT)
    assert load_run(tmp_path / "r").state == "done"
