"""A bench is watched sample by sample: what is passed is found, what is allowed runs on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.guard import EXCITED, FREE, JOGGED, Guard, GuardSettings, JointRole, rate_window
from rig.model.channels import kind_of
from rig.model.parts import BenchLimits
from rig.model.trips import SafetyTrip, Violation, describe
from rig.runs.rigs import load_rig

RIG = load_rig("shinshu-2dof")
NAMES = RIG.recorded
N = 240


def quiet_stream(seed: int = 0, n: int = N) -> NDArray[np.float64]:
    """Two joints moving at 1 Hz as on the seed bench, with its sensor noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RIG.sample_rate
    data = np.zeros((n, len(NAMES)))
    for column, name in enumerate(NAMES):
        if name.startswith("piston"):
            data[:, column] = 0.030 * np.sin(2 * np.pi * t) + rng.normal(0, 10e-6, n)
        elif "pressure" in name:
            data[:, column] = 3e6 + 1e6 * np.sin(2 * np.pi * t) + rng.normal(0, 5e3, n)
        elif name.startswith("oil"):
            data[:, column] = 40.0
    return data


def blocks(
    data: NDArray[np.float64],
    cuts: list[int],
    marks: NDArray[np.bool_] | None = None,
    first_tick: int = 1000,
) -> list[SampleBlock]:
    if marks is None:
        marks = np.zeros((len(data), len(RIG.channels)), dtype=bool)
    edges = sorted({0, len(data), *cuts})
    return [
        SampleBlock(i, first_tick + a, data[a:b], marks[a:b], 0, False)
        for i, (a, b) in enumerate(pairwise(edges))
    ]


def first_violation(guard: Guard, stream: list[SampleBlock]) -> Violation | None:
    for block in stream:
        violation = guard.check(block)
        if violation is not None:
            assert block.tick <= violation.tick < block.tick + len(block.data)
            return violation
    return None


@dataclass(frozen=True)
class Fault:
    channel: str
    value: float
    limit: str


FAULTS = [
    Fault("cap_pressure_1", 9.05e6, "pressure"),
    Fault("rod_pressure_2", -0.21e6, "pressure"),
    Fault("piston_2", 0.0361, "piston"),
    Fault("piston_2", -0.0361, "piston"),
    Fault("piston_1", 0.0021, "lock"),
    Fault("command_1", 4.2, "command"),
    Fault("spool_1", np.nan, "finite samples"),
    Fault("oil_temperature", np.inf, "finite samples"),
    Fault("supply_pressure", -np.inf, "finite samples"),
]
CUTS = st.lists(st.integers(1, N - 1), max_size=12)


@given(st.sampled_from(FAULTS), st.integers(0, N - 1), CUTS)
@settings(max_examples=150)
def test_one_violating_sample_is_found_wherever_blocks_are_cut(
    fault: Fault, row: int, cuts: list[int]
) -> None:
    data = quiet_stream()
    data[:, NAMES.index("piston_1")] = 0.001  # joint 1 is locked there
    guard = Guard(RIG)
    guard.set_roles([JointRole(locked_at=0.001, tolerance=1e-3), EXCITED])
    assert first_violation(guard, blocks(data, cuts)) is None
    guard.forget()
    data[row, NAMES.index(fault.channel)] = fault.value
    found = first_violation(guard, blocks(data, cuts))
    assert found is not None
    assert (found.channel, found.limit, found.tick) == (fault.channel, fault.limit, 1000 + row)
    np.testing.assert_equal(found.value, fault.value)


@given(st.integers(10, N - 10), CUTS, st.sampled_from(["cap_pressure_2", "piston_1"]))
@settings(max_examples=80)
def test_a_jump_within_the_limits_is_a_rate_and_found_across_blocks(
    row: int, cuts: list[int], channel: str
) -> None:
    data = np.zeros((N, len(NAMES)))
    data[row:, NAMES.index(channel)] = 5e6 if "pressure" in channel else 2e-3
    found = first_violation(Guard(RIG), blocks(data, cuts))
    assert found is not None
    assert found.channel == channel
    assert found.limit == ("pressure rate" if "pressure" in channel else "piston speed")
    assert found.tick == 1000 + row
    assert abs(found.value) > found.allowed[1]


@given(st.integers(0, N - 5), CUTS)
@settings(max_examples=60)
def test_five_saturated_samples_in_a_row_trip_and_four_do_not(row: int, cuts: list[int]) -> None:
    data = quiet_stream()
    marks = np.zeros((N, len(RIG.channels)), dtype=bool)
    column = RIG.channels.index("piston_1")
    marks[row : row + 4, column] = True
    marks[: max(row - 2, 0) : 3, column] = True  # single ones, never in a row
    assert first_violation(Guard(RIG), blocks(data, cuts, marks)) is None
    marks[row : row + 5, column] = True
    found = first_violation(Guard(RIG), blocks(data, cuts, marks))
    assert found is not None
    assert (found.limit, found.channel, found.tick) == ("saturated sensor", "piston_1", 1004 + row)


def test_cavitating_oil_may_rest_at_the_bottom_of_its_sensor_but_a_dead_sensor_may_not() -> None:
    data = quiet_stream()
    column = RIG.channels.index("cap_pressure_1")
    data[:, column] = -0.1e6
    marks = np.zeros((N, len(RIG.channels)), dtype=bool)
    noisy = np.random.default_rng(1).random(N) < 0.6
    marks[:, column] = noisy
    assert first_violation(Guard(RIG), blocks(data, [50, 90], marks)) is None
    marks[:, column] = True
    found = first_violation(Guard(RIG), blocks(data, [50, 90], marks))
    assert found is not None
    assert found.tick == 1000 + GuardSettings().saturated_samples_vacuum - 1


def test_ten_times_the_stated_noise_budget_is_needed_before_noise_alone_could_trip() -> None:
    tight = RIG.model_copy(
        update={
            "joints": tuple(
                joint.model_copy(
                    update={"limits": joint.limits.model_copy(update={"pressure_rate": 50e6})}
                )
                for joint in RIG.joints
            )
        }
    )
    data = np.zeros((20_000, len(NAMES)))
    pressures = [i for i, name in enumerate(NAMES) if "pressure" in name]
    data[:, pressures] = np.random.default_rng(3).normal(3e6, 5e3, (20_000, len(pressures)))
    guard = Guard(tight)
    assert rate_window(5e3, 50e6, 1000.0) == 9
    assert first_violation(guard, blocks(data, list(range(10, 20_000, 10)))) is None
    data[10_000:, pressures[0]] += np.minimum(np.arange(10_000) * 60e3, 3e6)  # 60 MPa/s
    guard.forget()
    found = first_violation(guard, blocks(data, list(range(10, 20_000, 10))))
    assert found is not None
    assert (found.limit, found.channel) == ("pressure rate", "cap_pressure_1")
    assert 10_000 < found.tick - 1000 <= 10_009


def moving(n: int = 600) -> NDArray[np.float64]:
    """Both joints driven at 1 Hz, every sensor read through its converter."""
    data = quiet_stream(n=n)
    rng = np.random.default_rng(5)
    t = np.arange(n) / RIG.sample_rate
    for joint in (1, 2):
        data[:, NAMES.index(f"command_{joint}")] = np.sin(2 * np.pi * t)
        spool = 0.1 * np.sin(2 * np.pi * t) + rng.normal(0, 0.2e-3, n)
        data[:, NAMES.index(f"spool_{joint}")] = spool
    for column, name in enumerate(RIG.channels):
        low, high = RIG.sensors.of(kind_of(name)[0]).range
        code = (high - low) / 65535
        data[:, column] = low + np.round((data[:, column] - low) / code) * code
    return data


@pytest.mark.parametrize("channel", ["piston_2", "cap_pressure_2", "rod_pressure_2", "spool_2"])
@given(cuts=CUTS)
@settings(max_examples=15)
def test_a_sensor_that_freezes_while_its_joint_moves_trips(channel: str, cuts: list[int]) -> None:
    data = moving()
    guard = Guard(RIG)
    guard.set_roles([EXCITED, EXCITED])
    assert first_violation(guard, blocks(data, [*cuts, *range(0, 600, 10)])) is None
    guard.forget()
    data[200:, NAMES.index(channel)] = data[200, NAMES.index(channel)]
    found = first_violation(guard, blocks(data, [*cuts, *range(0, 600, 10)]))
    assert found is not None
    assert (found.limit, found.channel, found.joint) == ("frozen sensor", channel, 2)
    assert 1000 + 200 + 249 <= found.tick <= 1000 + 200 + 260
    said = str(SafetyTrip(found, RIG))
    assert f"limit 'frozen sensor', {channel} of joint 2 (arm)" in said
    assert "0.25 s" in said


@pytest.mark.parametrize("volts", [0.15, -0.15])
def test_a_position_that_freezes_during_a_jog_trips(volts: float) -> None:
    """The command of a jog is constant, and spool and pressures with it."""
    data, every_ten = quiet_stream(n=600), list(range(10, 600, 10))
    data[:, NAMES.index("command_2")] = volts
    sensor, rng = RIG.sensors.piston, np.random.default_rng(6)
    code = np.ptp(sensor.range) / ((1 << sensor.bits) - 1)
    piston = 1e-5 * volts * np.arange(600) + rng.normal(0.0, sensor.noise, 600)
    data[:, NAMES.index("piston_2")] = code * np.round(piston / code)
    guard = Guard(RIG)
    guard.set_roles([FREE, JOGGED])
    assert first_violation(guard, blocks(data, every_ten)) is None
    guard.forget()
    data[200:, NAMES.index("piston_2")] = data[200, NAMES.index("piston_2")]
    found = first_violation(guard, blocks(data, every_ten))
    assert found is not None
    assert (found.limit, found.channel, found.joint) == ("frozen sensor", "piston_2", 2)
    guard.forget()
    data[:, NAMES.index("command_2")] = 0.0
    assert first_violation(guard, blocks(data, every_ten)) is None  # a closed valve may hold it


def test_what_may_stand_still_is_not_called_frozen() -> None:
    every_ten = list(range(10, 600, 10))
    frozen = moving()
    frozen[:, NAMES.index("piston_2")] = 0.01
    guard = Guard(RIG)
    guard.set_roles([EXCITED, JointRole(locked_at=0.01, tolerance=1e-3)])
    assert first_violation(guard, blocks(frozen, every_ten)) is None  # a locked joint
    guard = Guard(RIG)
    guard.set_roles([EXCITED, EXCITED])
    at_rest = frozen.copy()
    at_rest[:, NAMES.index("command_2")] = 0.0
    assert first_violation(guard, blocks(at_rest, every_ten)) is None  # nothing drives it
    guard.forget()
    cavitating = moving()
    cavitating[:, NAMES.index("cap_pressure_2")] = -0.1e6
    assert first_violation(guard, blocks(cavitating, every_ten)) is None  # the end of the range
    coarse = RIG.sensors.piston.model_copy(update={"bits": 8})  # a code is 31 noises
    rough = RIG.model_copy(update={"sensors": RIG.sensors.model_copy(update={"piston": coarse})})
    guard = Guard(rough)
    guard.set_roles([EXCITED, EXCITED])
    assert first_violation(guard, blocks(frozen, every_ten)) is None  # it may rest on a code


@pytest.mark.parametrize(
    ("channel", "value", "limit"),
    [("supply_pressure", 5.4e6, "supply pressure"), ("oil_temperature", 61.0, "oil temperature")],
)
def test_supply_and_oil_have_limits_where_the_rig_file_gives_them(
    channel: str, value: float, limit: str
) -> None:
    given_limits = BenchLimits(supply_pressure=(1e6, 5e6), oil_temperature=(20.0, 60.0))
    data = quiet_stream()
    data[100:, NAMES.index(channel)] = value
    assert first_violation(Guard(RIG), blocks(data, [50])) is None
    limited = RIG.model_copy(update={"limits": given_limits})
    found = first_violation(Guard(limited), blocks(data, [50]))
    assert found is not None
    assert (found.limit, found.channel, found.tick) == (limit, channel, 1100)
    assert f"limit '{limit}', {channel} of the bench: " in str(SafetyTrip(found, limited))


def test_a_free_joint_may_touch_its_end_and_an_excited_one_may_not() -> None:
    data = np.zeros((20, len(NAMES)))
    data[:, NAMES.index("piston_1")] = -0.0376
    guard = Guard(RIG)
    guard.set_roles([FREE, FREE])
    assert first_violation(guard, blocks(data, [])) is None
    guard.set_roles([EXCITED, FREE])
    found = first_violation(guard, blocks(data, []))
    assert found is not None
    assert found.limit == "piston"
    data[:, NAMES.index("piston_1")] = -0.0395
    guard.set_roles([FREE, FREE])
    guard.forget()
    found = first_violation(guard, blocks(data, []))
    assert found is not None
    assert found.limit == "stroke end"


def test_of_two_violations_the_earlier_in_device_time_is_named() -> None:
    data = np.zeros((30, len(NAMES)))
    data[20:, NAMES.index("cap_pressure_1")] = 9.5e6
    data[12, NAMES.index("piston_2")] = 0.003
    found = first_violation(Guard(RIG), blocks(data, []))
    assert found is not None
    assert (found.limit, found.channel, found.tick) == ("piston speed", "piston_2", 1012)


def test_a_gap_is_no_jump_but_a_long_one_is_a_trip_of_its_own() -> None:
    guard = Guard(RIG)
    low, high = np.zeros((10, len(NAMES))), np.zeros((10, len(NAMES)))
    high[:, NAMES.index("piston_1")] = 0.02
    (before,) = blocks(low, [])
    (after,) = blocks(high, [], first_tick=1030)
    assert guard.check(before) is None
    assert guard.gap(20, 1030) is None
    assert guard.check(after) is None
    found = guard.gap(200, 1240)
    assert found is not None
    assert (found.limit, found.value) == ("sample gap", 0.2)


def test_a_sensor_stuck_at_infinity_is_named_and_nothing_warns() -> None:
    data = np.zeros((10, len(NAMES)))
    data[4:, NAMES.index("rod_pressure_1")] = np.inf
    found = first_violation(Guard(RIG), blocks(data, [6]))
    assert found is not None
    assert (found.limit, found.tick) == ("finite samples", 1004)


def test_old_data_is_stale_after_the_rigs_watchdog_time() -> None:
    guard = Guard(RIG)
    assert guard.stale(0.49, 5) is None
    found = guard.stale(0.51, 5)
    assert found is not None
    assert found.limit == "stale data"


@pytest.mark.parametrize("limit", ["pressure", "lock", "finite samples"])
def test_the_trips_message_names_limit_value_allowed_joint_channel_and_time(limit: str) -> None:
    violation = {
        "pressure": Violation(limit, 9.31e6, (-2e5, 9e6), "Pa", 1, "cap_pressure_1", 12345, 2.5),
        "lock": Violation(limit, 0.0042, (0.0, 0.002), "m", 2, "piston_2", 500),
        "finite samples": Violation(limit, np.nan, (0, 1), "V", 1, "spool_1", 1),
    }[limit]
    said = str(SafetyTrip(violation, RIG))
    wanted = {
        "pressure": "limit 'pressure', cap_pressure_1 of joint 1 (boom): 9.31 MPa at 2.5000 s, "
        "allowed -0.2 to 9 MPa",
        "lock": "limit 'lock', piston_2 of joint 2 (arm): 4.2 mm at 0.5000 s of the "
        "device's clock, allowed 0 to 2 mm",
        "finite samples": "spool_1 of joint 1 (boom): nan V at 0.0010 s of the device's clock, "
        "allowed finite numbers",
    }[limit]
    assert wanted in said
    assert "\n" not in said


def test_a_trip_just_beyond_its_limit_shows_a_value_that_differs_from_it() -> None:
    rig = load_rig("shinshu-2dof")
    allowed = (9.99e6, 11e6)
    trip = Violation("supply pressure", 9.98996e6, allowed, "Pa", None, "supply_pressure", 20)
    assert "9.98996 MPa at 0.0200 s" in describe(trip, rig)
    assert "9.31 MPa" in describe(replace(trip, value=9.31e6), rig)
