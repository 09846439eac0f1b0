"""A plant that computes a block ahead shows the same samples as a plant that does not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_sim.faults.sensors import SensorStuck
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.plant.interface import Law, Prefetch
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.model.wire import registers as reg
from tests.hil_sim.device_bench import Bench
from tests.hil_sim.integrator import seed_rig
from tests.hil_sim.plant_trace import CLOSED, bench, sine

RIG = bench()
LAWS = ([CLOSED, CLOSED], [CLOSED, sine(RIG, 1.0)], [sine(RIG, 2.0), Law(bias=0.3, limit=1.0)])
Asked = list[tuple[int, int, int, int]]


FILTERED = Scenario.model_validate(
    {
        "effects": [
            {"name": "sensor_lag", "channel": "cap_pressure_2", "time": 0.004},
            {"name": "sensor_crosstalk", "channel": "rod_pressure_1", "share": 0.05},
            {"name": "spool_hysteresis", "where": "joint 2", "width": 0.05},
        ]
    }
)


@pytest.mark.parametrize("scenario", [Scenario(), FILTERED], ids=["plain", "filtered"])
@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 2), st.integers(1, 300), st.integers(0, 2)),
        min_size=1,
        max_size=8,
    )
)
def test_samples_are_the_same_whether_the_block_ahead_was_right_or_wrong(
    scenario: Scenario, asked: Asked
) -> None:
    ahead, plain = Prefetch(Plant(RIG, scenario, 4)), Plant(RIG, scenario, 4)
    for early, guess, ticks, laws in asked:
        for n in range(early):
            ahead.prefetch(10 if ticks % 2 else ticks, LAWS[(guess + n) % 3])
        assert ahead.tick == plain.tick
        for found, expected in zip(
            ahead.advance(ticks, LAWS[laws]), plain.advance(ticks, LAWS[laws]), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
    assert ahead.tick == plain.tick


class Counting(Plant):
    """The plant, with a note of how many ticks it was really run."""

    ran = 0

    def advance(self, ticks: int, laws: object) -> tuple[np.ndarray, np.ndarray]:
        self.ran += ticks
        return super().advance(ticks, laws)  # type: ignore[arg-type]


def test_a_block_computed_ahead_is_not_computed_again() -> None:
    plant = Counting(RIG, Scenario(), 4)
    ahead = Prefetch(plant)
    for _ in range(20):
        ahead.prefetch(10, LAWS[1])
        ahead.advance(10, LAWS[1])
    assert plant.ran == 200
    ahead.prefetch(10, LAWS[1])
    ahead.advance(10, LAWS[2])
    assert plant.ran == 220


def test_new_laws_discard_a_block_computed_ahead_before_the_host_reads_it() -> None:
    plant = Counting(RIG, Scenario(), 4)
    ahead = Prefetch(plant)
    ahead.prefetch(10, LAWS[1])
    ahead.prefetch(10, LAWS[2])
    assert (plant.ran, plant.tick, ahead.tick) == (20, 10, 0)
    ahead.advance(10, LAWS[2])
    assert (plant.ran, ahead.tick) == (20, 10)


def test_a_device_reads_as_if_nothing_were_computed_ahead() -> None:
    rig = seed_rig()
    found = []
    for ahead in (False, True):
        host = Bench(realtime=False, plant=Plant(rig, Scenario(), 1))
        host.write(reg.CONTROL_STREAM, reg.STREAM_START)
        blocks, last = [], 0xFFFF
        for n in range(40):
            if ahead:
                host.device.prefetch()
            if n % 7 == 3:
                host.drive(0.1 * n)
            assert host.status(reg.STATUS_TICK) == 10 * n
            header, commands = host.exchange(last)
            last = header.sequence
            blocks.append((header, commands.tolist()))
        found.append(blocks)
    assert found[0] == found[1]


def test_a_plant_with_faults_is_never_run_ahead() -> None:
    fault = SensorStuck(name="sensor_stuck", at=0.5, until=1.0, channel=RIG.channels[0])
    plant = FaultyPlant(RIG, Scenario(faults=(fault,)), 4)
    Prefetch(plant).prefetch(10, LAWS[0])
    assert plant.tick == 0


@pytest.mark.parametrize("realtime", [True, False])
def test_only_in_virtual_time_is_anything_computed_ahead(realtime: bool) -> None:
    plant = Plant(seed_rig(), Scenario(), 1)
    host = Bench(realtime=realtime, plant=plant)
    host.write(reg.CONTROL_STREAM, reg.STREAM_START)
    before = plant.tick
    host.device.prefetch()
    assert plant.tick - before == (0 if realtime else 10)
