"""A protocol runs on a bench: joints are locked, excited, centred, and records are alike."""

from __future__ import annotations

import numpy as np
import pytest

from protocols.engine.engine import run
from protocols.files.library import load
from protocols.files.plan import Overrides, Plan, resolve
from protocols.files.schema import Protocol
from rig.model.parse import parse_model
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.protocols.little_bench import Cylinder, LittleBench, default_cylinders

Phase = tuple[str, str, int, int, str]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


@pytest.fixture(scope="module")
def shipped(rig: Rig) -> tuple[Plan, LittleBench, list[Phase]]:
    """The demo's protocol, two repeats, on a bench whose joints drift both ways."""
    plan = resolve(load("lock-and-excite-multisine"), rig, Overrides(repeats=2))
    bench = LittleBench(rig, default_cylinders())
    phases: list[Phase] = []
    run(plan, rig, bench, lambda *phase: phases.append(phase))
    return plan, bench, phases


Shipped = tuple[Plan, LittleBench, list[Phase]]


def test_every_record_of_the_plan_is_there_complete_and_once(shipped: Shipped) -> None:
    plan, bench, _ = shipped
    assert [r.meta.name for r in bench.complete] == list(plan.records)
    assert all(r.ticks == 10_000 for r in bench.complete)


def test_the_waveform_in_a_record_starts_at_its_first_sample(shipped: Shipped) -> None:
    """What was put out, less its mean, is the wave itself; up to the trim at the boundary."""
    plan, bench, _ = shipped
    for record in bench.complete:
        step = next(s for s in plan.steps if s.name == record.meta.step)
        (part,) = step.excite
        command = bench.channel(f"command_{part.joint + 1}", record.start, record.ticks)
        wave = np.tile(part.wave.samples, record.ticks // part.wave.period)
        left = command - wave
        assert np.std(left[20:]) < 1e-12  # open loop: nothing but the bias is added
        assert left[-1] == pytest.approx(record.attributes[f"bias_v_{part.joint + 1}"])


def test_repeats_of_a_step_have_the_same_motion(shipped: Shipped) -> None:
    _, bench, _ = shipped
    for first, second in zip(bench.complete[::2], bench.complete[1::2], strict=True):
        assert first.meta.step == second.meta.step
        name = f"piston_{first.attributes['excited']}"
        one = bench.channel(name, first.start, first.ticks)
        two = bench.channel(name, second.start, second.ticks)
        assert np.ptp(one) > 0.02
        apart = (one - one.mean()) - (two - two.mean())
        assert np.sqrt(np.mean(apart**2)) < 0.03 * np.std(one)


def test_the_excited_piston_stays_centred_though_the_valve_is_not_symmetric(
    shipped: Shipped,
) -> None:
    plan, bench, _ = shipped
    for record in bench.complete:
        step = next(s for s in plan.steps if s.name == record.meta.step)
        (part,) = step.excite
        name = f"piston_{part.joint + 1}"
        assert abs(bench.channel(name, record.start, record.ticks).mean()) < 4e-3
        # One period apart the phase is the same: what differs is the drift.
        begins = bench.channel(name, record.start - 50, 100).mean()
        ends = bench.channel(name, record.start + record.ticks - 50, 100).mean()
        assert abs(ends - begins) < part.settings.centring.drift
    # Without a bias these gains drift by millimetres a second: not for free.
    assert all(
        abs(float(record.attributes[f"bias_v_{record.attributes['excited']}"])) > 5e-3
        for record in bench.complete
    )


def test_locked_joints_stand_where_the_step_wants_them(shipped: Shipped) -> None:
    plan, bench, _ = shipped
    for record in bench.complete:
        step = next(s for s in plan.steps if s.name == record.meta.step)
        (lock,) = step.locks
        j = lock.joint + 1
        piston = bench.channel(f"piston_{j}", record.start, record.ticks)
        assert np.abs(piston - lock.piston).max() < lock.tolerance
        assert record.meta.locked == (j,)
        assert record.attributes[f"lock_{j}"] == lock.at
        told = float(record.attributes[f"lock_give_m_{j}"])
        where = float(record.attributes[f"lock_piston_m_{j}"])
        assert told == pytest.approx(np.abs(piston - where).max())
        command = bench.channel(f"command_{j}", record.start, record.ticks)
        pushed = {"closed": 0.0, "end_min": -0.4, "end_max": 0.4}[lock.at]
        np.testing.assert_allclose(command, pushed, atol=1e-12)


def test_records_say_what_excited_them(shipped: Shipped) -> None:
    plan, bench, _ = shipped
    first = bench.complete[0]
    (part,) = plan.steps[0].excite
    assert first.meta.period == 10_000
    assert first.meta.lines == part.wave.lines
    empty = " ".join(map(str, part.wave.detection_lines))
    assert first.attributes["detection_lines_2"] == empty


def test_each_phase_is_told_in_its_order(shipped: Shipped) -> None:
    _, _, phases = shipped
    first = [(phase, repeat) for step, phase, repeat, _, _ in phases if step == "step1"]
    assert first == [
        ("place", 0), ("lock", 0), ("warm-up", 0), ("centre", 0),
        ("record", 1), ("record", 2), ("stop", 0),
    ]  # fmt: skip
    assert phases[-1][1] == "done"
    assert {repeats for _, phase, _, repeats, _ in phases if phase == "record"} == {2}


def test_it_ends_with_closed_valves(shipped: Shipped) -> None:
    _, bench, _ = shipped
    assert all(law.limit == 0.0 for law in bench.laws)


def test_the_guard_knows_who_is_excited_and_who_is_locked(rig: Rig) -> None:
    plan = resolve(load("validate"), rig, Overrides(steps=("step2_3hz",)))
    bench = LittleBench(rig, default_cylinders())
    seen = []
    run(
        plan, rig, bench,
        lambda step, phase, *_: seen.append((phase, tuple(bench.roles))) if bench.roles else None,
    )  # fmt: skip
    while_recording = dict(seen)["record"]
    assert while_recording[0].excited
    assert while_recording[0].locked_at is None
    assert not while_recording[1].excited
    assert while_recording[1].locked_at == pytest.approx(-0.0375, abs=1e-4)
    on_the_way = dict(seen)["lock"]
    assert not any(role.excited or role.locked_at is not None for role in on_the_way)


def test_both_joints_at_once_share_a_record(rig: Rig) -> None:
    plan = resolve(load("validate"), rig, Overrides(steps=("both_3hz",)))
    bench = LittleBench(rig, default_cylinders())
    run(plan, rig, bench)
    (record,) = bench.complete
    assert record.meta.locked == ()
    assert record.attributes["excited"] == "1 2"
    assert record.ticks == 5000
    for joint in (1, 2):
        piston = bench.channel(f"piston_{joint}", record.start, record.ticks)
        lines = np.abs(np.fft.rfft(piston - piston.mean()))
        assert int(np.argmax(lines)) == 15  # 3 Hz in 5 s
        assert abs(piston.mean()) < 3e-3


ONE = """\
name: one-sine
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 10 mm}]
    excite:
      - joint: 2
        signal: {kind: sine, frequency: 1 Hz, amplitude: 0.5 V}
        centre: -5 mm
        centring: {mode: MODE, position_gain: 3 V/m}
    repeats: 3
    duration: 3 s
    ramp: 1 s
"""


def one_sine(rig: Rig, mode: str = "open-loop") -> Plan:
    return resolve(parse_model(Protocol, ONE.replace("MODE", mode), "one.yaml"), rig)


def test_a_position_loop_may_stay_on_while_it_is_recorded(rig: Rig) -> None:
    plan = one_sine(rig, "position-loop")
    bench = LittleBench(rig, default_cylinders())
    run(plan, rig, bench)
    assert len(bench.complete) == 3
    for record in bench.complete:
        piston = bench.channel("piston_2", record.start, record.ticks)
        assert piston.mean() == pytest.approx(-5e-3, abs=1e-3)
        assert record.attributes["position_gain_v_per_m_2"] == 3.0
        locked = bench.channel("piston_1", record.start, record.ticks)
        assert np.abs(locked - 10e-3).max() < 1e-3


def test_blocks_lost_on_the_wire_do_not_shift_the_records(rig: Rig) -> None:
    plan = one_sine(rig)
    calm, lossy = (
        LittleBench(rig, default_cylinders(), lose=lost)
        for lost in ((), [*range(700, 2500, 97), *range(1500, 1504)])
    )
    for bench in (calm, lossy):
        run(plan, rig, bench)
        assert len(bench.complete) == 3
        assert {(r.start - bench.start) % 1000 for r in bench.complete} == {0}


@pytest.mark.parametrize("offset", [-0.08, 0.05])
def test_a_spool_off_its_null_is_found_and_countered(offset: float, rig: Rig) -> None:
    """The lock creeps at zero volts: the loop holds it. The excited joint's bias makes up."""
    cylinders = [Cylinder(offset=offset), Cylinder(extend=0.16, retract=0.16, offset=offset)]
    bench = LittleBench(rig, cylinders)
    run(one_sine(rig), rig, bench)
    assert len(bench.complete) == 3
    for record in bench.complete:
        assert float(record.attributes["lock_gain_v_per_m_1"]) > 0.0
        assert float(record.attributes["lock_give_m_1"]) < 2e-3
        assert float(record.attributes["bias_v_2"]) == pytest.approx(-offset, abs=5e-3)


SLOW = """
name: slow
joints: 2
steps:
  - name: slow
    repeats: 2
    lock: [{joint: 2, at: end_min}]
    excite:
      - joint: 1
        signal:
          kind: lines
          base_frequency: 0.1 Hz
          lines: [1, 3, 5, 7, 9]
          amplitudes: [0.1 V, 0.058 V, 0.045 V, 0.038 V, 0.034 V]
          phases: [-0.2 rad, -0.73 rad, -1.76 rad, -2.7 rad, 2.75 rad]
        centring: {drift: 4 mm, offset: 4 mm, tries: 6}
"""


def test_a_slow_wave_is_let_go_where_it_goes_on_centred(rig: Rig) -> None:
    """A swing of 23 mm in ten seconds, whose phase the centring loop had turned."""
    bench = LittleBench(rig, default_cylinders())
    run(resolve(parse_model(Protocol, SLOW, "slow.yaml"), rig), rig, bench)  # raises at a limit
    assert len(bench.complete) == 2
    for record in bench.complete:
        piston = bench.channel("piston_1", record.start, record.ticks)
        assert np.ptp(piston) > 0.045
        assert abs(piston.mean()) < 4e-3
    # From wherever a boundary finds it, it would go out to 35.8 mm before it is caught.
    assert np.abs(bench.channel("piston_1")).max() < 33e-3
