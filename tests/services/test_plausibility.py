"""A bench that breaks while it moves is noticed in time, and one that only ages is left alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.base import OutputLaw, SampleBlock
from drivers.in_process import InProcessDriver
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.scenario.file import Scenario, parse_scenario
from protocols.engine import engine
from protocols.files.library import load
from protocols.files.plan import Overrides, resolve
from rig.bench.checks.pressure_sensors import ROW_SECONDS, drifting, swing_ratio
from rig.bench.guard import EXCITED, FREE, Guard, JointRole
from rig.bench.session import Bench
from rig.bench.settings import GuardSettings
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.trips import Violation
from rig.runs.rigs import load_rig
from tests.variants import kept

RIG = load_rig("shinshu-2dof")
BREAKS = 2.0  # [s]
LOCK = JointRole(locked_at=0.0, tolerance=2e-3)
T = np.arange(1000) / RIG.sample_rate
WAVES = {
    "sine": 0.6 * np.sin(2 * np.pi * T),
    "multisine": 0.2 * sum(np.sin(2 * np.pi * k * T + k * k) for k in (1, 2, 3, 5, 7, 11, 13, 17)),
}


def driver_of(scenario: str, rig: Rig = RIG, seed: int = 3) -> InProcessDriver:
    """A simulated bench in this process, as a driver."""
    what = parse_scenario(scenario, "scenario.yaml") if scenario else Scenario()
    return InProcessDriver(
        Wire(kind="in-process"), rig, make=lambda rig: FaultyPlant(rig, what, seed)
    )


def blocks_of(driver: InProcessDriver, wave: str, seconds: float) -> Iterator[SampleBlock]:
    """Joint 1 closed, joint 2 moved by a wave."""
    driver.connect()
    driver.upload(1, WAVES[wave])
    driver.start()
    driver.apply([OutputLaw(), OutputLaw(1.0, 0.0, 5.0, 0.0, 4.0)], restart=True)
    passed = 0
    while passed < seconds * RIG.sample_rate:
        block = driver.read_block()
        passed += len(block.data)
        yield block


def noticed(scenario: str, wave: str = "sine", seconds: float = BREAKS + 2.0) -> list[Violation]:
    """What trips or warns, in the order in which it is noticed, up to the first trip."""
    guard = Guard(RIG)
    guard.set_roles([LOCK, EXCITED])
    found: dict[object, Violation] = {}
    for block in blocks_of(driver_of(scenario), wave, seconds):
        trip = guard.check(block)
        for key, warning in guard.warnings.items():
            found.setdefault(key, warning)
        if trip is not None:
            return [*found.values(), trip]
    return list(found.values())


def fault(text: str) -> str:
    return f"faults: [{{{text}, at: {BREAKS} s}}]"


FAULTS = [
    ("name: sensor_stuck, channel: cap_pressure_2", "frozen sensor", "cap_pressure_2"),
    ("name: sensor_stuck, channel: piston_2", "frozen sensor", "piston_2"),
    ("name: sensor_stuck, channel: spool_2", "frozen sensor", "spool_2"),
    ("name: sensor_drift, channel: spool_2, rate: 0.1", "spool does not follow", "spool_2"),
    ("name: sensor_drift, channel: cap_pressure_2, rate: 0.4", "pressure", "cap_pressure_2"),
    ("name: sensor_drift, channel: piston_1, rate: 0.1", "lock", "piston_1"),
    ("name: sensor_drift, channel: cap_pressure_2, rate: 0.1", "drifting pressure sensor",
     "cap_pressure_2"),
    ("name: sensor_drift, channel: rod_pressure_2, rate: 0.05", "drifting pressure sensor",
     "rod_pressure_2"),
    ("name: swapped_channels, channel: cap_pressure_1, other: cap_pressure_2",
     "swapped pressures", "cap_pressure"),
    ("name: swapped_channels, channel: rod_pressure_2, other: rod_pressure_1",
     "swapped pressures", "rod_pressure"),
    ("name: sensor_noise, channel: rod_pressure_1, deviation: 0.01", "noisy sensor",
     "rod_pressure_1"),
    ("name: sensor_noise, channel: piston_2, deviation: 0.003", "noisy sensor", "piston_2"),
    ("name: broken_wire, channel: oil_temperature", "saturated sensor", "oil_temperature"),
    ("name: broken_wire, channel: rod_pressure_2, end: high", "pressure", "rod_pressure_2"),
    ("name: broken_wire, channel: cap_pressure_1", "saturated sensor", "cap_pressure_1"),
    ("name: swapped_channels, channel: spool_1, other: spool_2", "spool does not follow", "spool"),
    ("name: swapped_channels, channel: piston_1, other: piston_2", "piston speed", "piston"),
    ("name: valve_stuck, where: joint 2", "spool does not follow", "spool_2"),
    ("name: hose_burst, where: joint 2, chamber: cap", "piston", "piston_2"),
    ("name: hose_burst, where: joint 2, chamber: cap, conductance: 2e-9 m^3/(s*Pa)",
     "chamber without pressure", "cap_pressure_2"),
    ("name: hose_burst, where: joint 1, chamber: cap", "lock", "piston_1"),
    ("name: joint_unlocks, where: joint 1", "lock", "piston_1"),
    ("name: pump_off", "supply pressure", "supply_pressure"),
]  # fmt: skip


@pytest.mark.parametrize(("what", "limit", "channel"), FAULTS, ids=[f[0][6:] for f in FAULTS])
def test_what_breaks_is_noticed_by_its_name_within_two_seconds(
    what: str, limit: str, channel: str
) -> None:
    found = noticed(fault(what))
    assert found, "nothing was noticed"
    assert all(violation.tick >= BREAKS * RIG.sample_rate for violation in found)
    named = [v for v in found if v.limit == limit and v.channel.startswith(channel)]
    assert named, found
    assert found[-1].tick <= (BREAKS + 2.0) * RIG.sample_rate


@pytest.mark.parametrize("wave", WAVES)
def test_a_sound_bench_raises_nothing(wave: str) -> None:
    assert noticed("", wave, 3.0) == []


def test_a_stuck_spool_is_noticed_under_a_fast_wave_and_an_overlapped_one_is_not() -> None:
    stuck = noticed(fault("name: valve_stuck, where: joint 2"), "multisine")
    assert [v.limit for v in stuck] == ["spool does not follow"]
    lapped = "effects: [{name: valve_deadband, where: joint 2, width: 20 mV}]"
    assert noticed(lapped, "multisine") == []


def guarded_run(scenario: str, protocol: str, rig: Rig = RIG) -> Bench:
    """Run the first step of a shipped protocol on a simulated bench; return its session."""
    plan = load(protocol)
    first = plan.steps[0].name
    with Bench(rig, driver_of(scenario, rig), signals=False) as bench:
        engine.run(resolve(plan, rig, Overrides(repeats=1, steps=(first,))), rig, bench)
    return bench


@pytest.mark.parametrize(
    ("scenario", "protocol"),
    kept(
        [
            ("", "lock-and-excite"),
            ("{name: valve_deadband, where: joint 2, width: 10 mV}", "lock-and-excite-multisine"),
            ("{name: internal_leakage, where: joint 1, conductance: 2e-12 m^3/(s*Pa)}", "validate"),
        ],
        (2,),
    ),
)
def test_a_bench_that_only_ages_runs_a_shipped_protocol_without_an_alarm(
    scenario: str, protocol: str
) -> None:
    bench = guarded_run(f"effects: [{scenario}]" if scenario else "", protocol)
    assert bench.alarms.alarms == ()


def test_a_joint_that_falls_with_its_valve_closed_is_called_a_drift() -> None:
    guard = Guard(RIG)
    guard.set_roles([FREE, FREE])
    driver = driver_of("faults: [{name: hose_burst, where: joint 1, at: 0.6 s}]")
    driver.connect()
    driver.start()
    for _ in range(200):
        guard.check(driver.read_block())
    assert ("drift at rest", "piston_1", 1) in guard.warnings


def test_a_spool_that_is_open_while_nothing_moves_is_named() -> None:
    guard = Guard(RIG)
    guard.set_roles([FREE, FREE])
    rng = np.random.default_rng(2)
    data = np.full((2000, len(RIG.recorded)), 3e6) + rng.normal(0, 5e3, (2000, len(RIG.recorded)))
    deviation = {"spool": (0.0, 0.2e-3), "piston": (0.0, 10e-6), "command": (0.0, 0.0)}
    for column, name in enumerate(RIG.recorded):
        mean, noise = deviation.get(name[:-2], (np.nan, 0.0))
        if np.isfinite(mean):
            data[:, column] = rng.normal(mean, noise, 2000)
    data[:, RIG.recorded.index("supply_pressure")] += 4e6
    data[:, RIG.recorded.index("oil_temperature")] = 40 + rng.normal(0, 0.05, 2000)
    data[:, RIG.recorded.index("command_1")] = 1.5
    data[:, RIG.recorded.index("spool_1")] += 0.15
    marks = np.zeros((10, len(RIG.channels)), dtype=bool)
    for k in range(200):
        rows = slice(10 * k, 10 * k + 10)
        assert guard.check(SampleBlock(k, 10 * k, data[rows], marks, 0, False)) is None
    assert set(guard.warnings) == {("nothing moves", "piston_1", 1)}


def test_what_a_check_does_is_up_to_the_rig_file() -> None:
    ignoring = {"spool_not_following": "ignore", "frozen_sensor": "warn"}
    calm = Rig.model_validate({**RIG.model_dump(), "alarms": {"checks": ignoring}})
    guard = Guard(calm)
    guard.set_roles([LOCK, EXCITED])
    broken = fault("name: sensor_stuck, channel: spool_2")
    for block in blocks_of(driver_of(broken), "sine", BREAKS + 1.0):
        assert guard.check(block) is None
    assert set(guard.warnings) == {("frozen sensor", "spool_2", 2)}


@pytest.mark.parametrize("piston", [-0.03, 0.0, 0.03])
def test_the_pressures_of_a_closed_cylinder_swing_in_the_ratio_of_the_plants_volumes(
    piston: float,
) -> None:
    """The ratio against the oil's own law p = b (V0 / V - 1), for a small stroke of the piston."""
    part = RIG.joints[0].cylinder
    moved = 1e-6  # [m]
    cap_length = part.cap_pipe_volume / part.cap_area + part.stroke / 2 + piston
    rod_length = part.rod_pipe_volume / part.rod_area + part.stroke / 2 - piston
    cap = cap_length / (cap_length + moved) - 1.0
    rod = rod_length / (rod_length - moved) - 1.0
    assert swing_ratio(RIG, 0, piston) == pytest.approx(-cap / rod, rel=1e-3)


def rows_of(force_trend: float, *, period: float = 1.0, ramp: float = 0.0) -> np.ndarray:
    """Means over 20 ms of a joint on a sine, its cap pressure with a part that grows with time."""
    t = np.arange(100) * ROW_SECONDS
    rng = np.random.default_rng(1)
    rows = np.zeros((100, 2, 4))
    rows[:, 0, 0] = 0.01 * np.sin(2 * np.pi * t / period) + ramp * t
    load = 3e6 + 4e7 * rows[:, 0, 0] + 2e5 * np.sign(np.gradient(rows[:, 0, 0]))
    rod = 1.5e6 + 3e5 * np.cos(2 * np.pi * t / period)
    cylinder = RIG.joints[0].cylinder
    rows[:, 0, 2] = rod
    rows[:, 0, 1] = load + rod * cylinder.rod_area / cylinder.cap_area + force_trend * t / t[-1]
    rows[:, 0, 1:3] += 1e3 * rng.standard_normal((100, 2))
    return rows


@pytest.mark.parametrize(
    ("trend", "motion", "channel"),
    [
        (1.5e6, {}, True),
        (-1.5e6, {}, True),
        (0.3e6, {}, None),
        (0.0, {}, None),
        (1.5e6, {"period": 8.0}, None),
        (1.5e6, {"ramp": 0.02}, None),
    ],
    ids=["up", "down", "small", "none", "slow motion", "ramp"],
)
def test_a_pressure_that_grows_with_time_alone_is_a_drift_and_one_with_the_motion_is_not(
    trend: float, motion: dict[str, float], channel: bool | None
) -> None:
    found = drifting(RIG, GuardSettings(), 0, rows_of(trend, **motion), ROW_SECONDS)
    assert (found is None) == (channel is None)
    if found is not None:
        assert found.cap
        assert found.value == pytest.approx(trend, rel=0.15)


def test_a_trend_in_both_chambers_is_a_load_and_no_sensor() -> None:
    rows = rows_of(1.5e6)
    rows[:, 0, 2] -= np.linspace(0.0, 1.0e6, 100)
    assert drifting(RIG, GuardSettings(), 0, rows, ROW_SECONDS) is None
