"""What a bench does that no protocol asked for, and how a run ends or goes on."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from protocols.design.check import NotCentred
from protocols.engine.engine import run
from protocols.engine.locking import placement
from protocols.engine.states import LockFailed, ProtocolAborted
from protocols.files.plan import Plan, largest_position_gain, resolve
from protocols.files.schema import Protocol
from rig.model.parse import parse_model
from rig.model.rig import Rig
from rig.model.trips import SafetyTrip, Violation
from rig.runs.rigs import load_rig
from tests.protocols.little_bench import Cylinder, Handle, LittleBench, default_cylinders

TEXT = """\
name: trouble
joints: 2
place: {timeout: 5 s}
steps:
  - name: step1
    lock: [LOCK]
    excite:
      - joint: 2
        signal: {kind: sine, frequency: 0.5 Hz, amplitude: AMPLITUDE}
        centring: {tries: 3}
    repeats: 3
    duration: 8 s
    ramp: 1 s
"""
CLOSED = "{joint: 1, at: closed, tolerance: 1 mm}"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def plan_of(rig: Rig, lock: str = CLOSED, amplitude: str = "0.3 V") -> Plan:
    text = TEXT.replace("LOCK", lock).replace("AMPLITUDE", amplitude)
    return resolve(parse_model(Protocol, text, "trouble.yaml"), rig)


def undisturbed(rig: Rig, plan: Plan) -> Handle:
    """The first record of a run to which nothing happens; until then every run is the same."""
    bench = LittleBench(rig, default_cylinders())
    run(plan, rig, bench)
    return bench.complete[0]


def test_a_lock_that_breaks_in_a_record_ends_the_run(rig: Rig) -> None:
    plan = plan_of(rig)
    bench = LittleBench(rig, default_cylinders())
    breaks_at = undisturbed(rig, plan).start + 3000

    def leak() -> None:
        bench.cylinders[0].load = 0.004  # m/s

    bench.happenings[breaks_at] = leak
    with pytest.raises(LockFailed) as caught:
        run(plan, rig, bench)
    assert str(caught.value).startswith(
        "lock failed in step1: joint 1 moved while locked (closed): piston measured at 1.0"
    )
    assert "expected 0.00 mm +- 1 mm" in str(caught.value)
    assert 200 < bench.tick - breaks_at < 400  # 1 mm at 4 mm/s, seen within a block
    assert [r.state for r in bench.records] == ["partial"]


def test_a_slow_leak_is_closed_anew_between_records(rig: Rig) -> None:
    """0.03 mm/s is too little to refuse the lock and too much for three records."""
    cylinders = default_cylinders()
    cylinders[0].load = 3e-5
    bench = LittleBench(rig, cylinders)
    phases: list[tuple[str, str]] = []
    run(plan_of(rig), rig, bench, lambda _, phase, *rest: phases.append((phase, rest[-1])))
    assert len(bench.complete) == 3
    assert any(phase == "lock" and "closed anew" in text for phase, text in phases)
    for record in bench.complete:
        assert float(record.attributes["lock_give_m_1"]) < 1e-3
        assert (record.start - bench.start) % 2000 == 0


def test_a_piston_that_does_not_reach_its_end_stop_is_no_lock(rig: Rig) -> None:
    bench = LittleBench(rig, default_cylinders())
    bench.cylinders[0].stop = 0.02  # jammed half way
    with pytest.raises(LockFailed, match=r"joint 1 did not reach its end stop \(end_max\)") as err:
        run(plan_of(rig, "{joint: 1, at: end_max}"), rig, bench)
    assert err.value.joint == 1
    assert err.value.measured == pytest.approx(0.02, abs=1e-4)
    assert "expected 37.50 mm +- 2 mm" in str(err.value)
    assert bench.records == []


def test_a_valve_connected_the_wrong_way_round_is_noticed_before_the_waveform(rig: Rig) -> None:
    bench = LittleBench(rig, [Cylinder(), Cylinder(extend=-0.16, retract=-0.16, piston=0.01)])
    with pytest.raises(
        ProtocolAborted, match=r"joint 2 did not reach its place.*the right way round"
    ):
        run(plan_of(rig), rig, bench)
    assert bench.records == []


def test_a_pump_that_is_off_is_noticed_from_the_place(rig: Rig) -> None:
    bench = LittleBench(rig, [Cylinder(), Cylinder(extend=0.0, retract=0.0, piston=0.01)])
    with pytest.raises(ProtocolAborted, match=r"piston measured at 10\.0. mm .*is the pump on"):
        run(plan_of(rig), rig, bench)


def test_a_loop_with_too_much_gain_is_named_by_its_gain(rig: Rig) -> None:
    """The machine is twice as fast as the rig file says, so that the check let it pass."""
    slow = rig.model_copy(update={"sample_rate": 50.0})
    plan = plan_of(slow)
    place = plan.protocol.place.model_copy(update={"position_gain": 500.0})
    assert largest_position_gain(slow, 1) > place.position_gain
    plan = replace(plan, protocol=plan.protocol.model_copy(update={"place": place}))
    fast = Cylinder(extend=0.32, retract=0.32, piston=0.01)
    with pytest.raises(ProtocolAborted, match=r"it swings from .* lower place.position_gain, 500"):
        run(plan, slow, LittleBench(slow, [Cylinder(), fast]))


def test_samples_lost_while_a_piston_is_placed_are_no_motion(rig: Rig) -> None:
    """Of a look that arrives with every sample lost, nothing is known and nothing is said."""
    session = SimpleNamespace(rate=1000.0, piston=lost, command=lost)
    reading = placement(session, 0, 0, 100)
    assert math.isnan(reading.piston)
    assert math.isnan(reading.speed)


def lost(joint: int, first: int, last: int) -> np.ndarray:
    return np.full(last - first, np.nan)


def test_a_pump_that_fails_later_is_noticed_from_the_motion(rig: Rig) -> None:
    """The place was right already, so only the warm-up can tell that nothing moves."""
    bench = LittleBench(rig, [Cylinder(), Cylinder(extend=0.0, retract=0.0)])
    with pytest.raises(ProtocolAborted, match="joint 2 does not follow its command"):
        run(plan_of(rig), rig, bench)


def test_a_drift_that_begins_in_a_record_is_caught_before_the_limit(rig: Rig) -> None:
    """The oil warms, a hose moves: the record is disturbed, dropped, and taken again."""
    plan = plan_of(rig, amplitude="0.5 V")
    bench = LittleBench(rig, default_cylinders())

    def drift() -> None:
        bench.cylinders[1].load = 0.004  # m/s: 32 mm in a record, 11 mm are left

    calm = undisturbed(rig, plan)
    bench.happenings[calm.start + 500] = drift
    run(plan, rig, bench)  # LittleBench raises Clipped where a limit is passed
    states = [r.state for r in bench.records]
    assert states[0] == "discarded"
    assert states.count("complete") == 3
    assert [r.meta.name for r in bench.complete] == ["step1_r1", "step1_r2", "step1_r3"]
    assert {(r.start - bench.start) % 2000 for r in bench.complete} == {0}
    piston = [bench.channel("piston_2", r.start, r.ticks) for r in bench.complete]
    assert all(abs(p[-2000:].mean() - p[:2000].mean()) < 2e-3 for p in piston)
    # The bias has changed by the drift over the gain, 0.155 and 0.175 m/s per volt on average.
    changed = bench.complete[-1].attributes["bias_v_2"] - calm.attributes["bias_v_2"]
    assert changed == pytest.approx(-0.004 / 0.165, rel=0.15)


def test_a_waveform_too_wide_for_the_stroke_is_given_up_with_advice(rig: Rig) -> None:
    plan = plan_of(rig, amplitude="0.6 V")  # +-34.4 mm: within the limits, but for nothing else
    bench = LittleBench(rig, [Cylinder(), Cylinder(extend=0.18, retract=0.18)])
    with pytest.raises(ProtocolAborted, match="lower the amplitude"):
        run(plan, rig, bench)
    assert not bench.complete


def test_what_the_bench_raises_passes_through_untouched(rig: Rig) -> None:
    class Stop(Exception):
        pass

    bench = LittleBench(rig, default_cylinders())

    def stop() -> None:
        raise Stop

    bench.happenings[undisturbed(rig, plan_of(rig)).start + 1000] = stop
    with pytest.raises(Stop):
        run(plan_of(rig), rig, bench)
    assert [r.state for r in bench.records] == ["partial"]


def test_a_disturbed_bench_never_makes_a_record_with_a_jump_in_its_command(rig: Rig) -> None:
    plan = plan_of(rig, amplitude="0.5 V")
    bench = LittleBench(rig, default_cylinders())

    def drift() -> None:
        bench.cylinders[1].load = -0.005

    bench.happenings[undisturbed(rig, plan).start + 2500] = drift
    run(plan, rig, bench)
    for record in bench.complete:
        command = bench.channel("command_2", record.start, record.ticks)
        wave = np.tile(plan.steps[0].excite[0].wave.samples, 4)
        assert np.ptp((command - wave)[20:]) < 1e-12


def test_what_ends_a_run_can_be_raised_in_another_process(rig: Rig) -> None:
    """A pool of processes breaks when an exception of a worker cannot be unpickled."""
    violation = Violation("pressure", 9.31e6, (-2e5, 9e6), "Pa", 1, "cap_pressure_1", 12345)
    lock = LockFailed("step1", 2, "moved while locked (closed)", 5.79e-3, "0.67 mm +- 5 mm")
    step = next(iter(plan_of(rig).steps))
    assert "joint 2 moved while locked (closed): piston measured at 5.79 mm" in str(lock)
    for error in (lock, SafetyTrip(violation, rig), NotCentred("not centred", step)):
        same = pickle.loads(pickle.dumps(error))
        assert type(same) is type(error)
        assert str(same) == str(error)
