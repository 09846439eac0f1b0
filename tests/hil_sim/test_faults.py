"""A bench that breaks while it runs: each fault does what it says, from its time on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil_sim.faults import CLASSES
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, check_fits, parse_scenario
from rig.model.parse import InputError
from tests.hil_sim.plant_trace import CLOSED, bench, sine

RIG = bench(1000.0)
MOVE_1 = [sine(RIG, 0.5, 1.0, position_gain=20.0), CLOSED]


def broken(fault: str) -> Scenario:
    return parse_scenario(f"faults: [{fault}]", "broken.yaml")


def both(fault: str, laws: list[Law], ticks: int = 600) -> tuple[np.ndarray, np.ndarray, Plant]:
    """Codes of the broken bench and of a sound one of the same seed, in uneven pieces."""
    bad, good = FaultyPlant(RIG, broken(fault), 5), Plant(RIG, Scenario(), 5)
    parts = [bad.advance(n, laws)[0] for n in (7, 193, 250, ticks - 450)]
    return np.vstack(parts), good.advance(ticks, laws)[0], bad.plant


def column(name: str) -> int:
    return RIG.channels.index(name)


def test_a_bench_without_faults_is_the_plant_itself() -> None:
    laws = MOVE_1
    plain, same = Plant(RIG, Scenario(), 2), FaultyPlant(RIG, Scenario(), 2)
    for n in (3, 40, 100):
        for a, b in zip(plain.advance(n, laws), same.advance(n, laws), strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("fault", "channel", "shows"),
    [
        ("{name: sensor_stuck, channel: piston_1, at: 0.3 s}", "piston_1",
         lambda bad, good: np.all(bad[300:] == bad[299]) and np.ptp(good[300:]) > 100),
        ("{name: broken_wire, channel: rod_pressure_2, at: 0.3 s}", "rod_pressure_2",
         lambda bad, good: np.all(bad[300:] == 0)),
        ("{name: sensor_drift, channel: cap_pressure_1, rate: 0.1, at: 0.3 s}", "cap_pressure_1",
         lambda bad, good: np.allclose((bad - good)[300:], 6.5535 * np.arange(300), atol=1.0)),
        ("{name: sensor_noise, channel: spool_1, deviation: 0.01, at: 0.3 s}", "spool_1",
         lambda bad, good: 0.8 < np.std((bad - good)[300:]) / 655.35 < 1.2),
    ],
    ids=lambda value: value if isinstance(value, str) and value[0] != "{" else "",
)  # fmt: skip
def test_a_faulty_sensor_shows_what_its_fault_says(fault: str, channel: str, shows) -> None:
    bad, good, _ = both(fault, MOVE_1)
    k = column(channel)
    assert np.array_equal(bad[:300], good[:300])
    assert shows(bad[:, k], good[:, k])
    others = [i for i in range(len(RIG.channels)) if i != k]
    assert np.array_equal(bad[:, others], good[:, others])


def test_channels_swapped_for_a_time_are_right_again_after_it() -> None:
    bad, good, _ = both(
        "{name: swapped_channels, channel: cap_pressure_1, other: cap_pressure_2,"
        " at: 0.2 s, until: 0.45 s}",
        MOVE_1,
    )
    a, b = column("cap_pressure_1"), column("cap_pressure_2")
    assert np.array_equal(bad[200:450, [a, b]], good[200:450, [b, a]])
    assert np.array_equal(bad[450:], good[450:])


def test_a_stuck_spool_stays_and_the_command_is_recorded_as_given() -> None:
    bad, good, plant = both("{name: valve_stuck, where: joint 1, at: 0.3 s}", MOVE_1)
    k = column("spool_1")
    sensor = RIG.sensors.of("spool")
    step = (sensor.range[1] - sensor.range[0]) / 65535
    assert np.std(bad[310:, k]) < 1.5 * sensor.noise / step
    assert np.ptp(good[310:, k]) > 500
    assert plant.tables.joints["spool_rate"][0] == 0.0


def test_a_burst_hose_empties_its_chamber_and_a_stopped_pump_the_supply() -> None:
    bad, good, _ = both("{name: hose_burst, where: joint 1, chamber: rod, at: 0.3 s}", MOVE_1)
    k = column("rod_pressure_1")
    assert bad[-1, k] < 0.5 * good[-1, k]
    bad, good, _ = both("{name: pump_off, at: 0.3 s}", MOVE_1, ticks=1500)
    k = column("supply_pressure")
    assert bad[-1, k] < good[-1, k] - 3000


def test_a_joint_that_gives_way_moves_with_its_valve_closed() -> None:
    lift = [CLOSED, Law(bias=0.4, limit=1.0)]
    bad, good = FaultyPlant(RIG, broken("{name: joint_unlocks, where: joint 1, at: 0.3 s}"), 5), \
        Plant(RIG, Scenario(), 5)  # fmt: skip
    for plant in (bad, good):
        plant.advance(3000, lift)
    moved = bad.plant.snapshot()["piston"][0] - good.snapshot()["piston"][0]
    assert abs(moved) > 1e-4


def test_every_fault_is_refused_where_it_cannot_be() -> None:
    for text, says in (
        ("{name: sensor_stuck, channel: piston_9}", "measures: spool_1"),
        ("{name: valve_stuck, where: joint 3}", "has 2 joint"),
        ("{name: swapped_channels, channel: piston_1, other: spool_1}", "two channels of one kind"),
        ("{name: pump_off, at: 2 s, until: 1 s}", "until 1 s is not after at 2 s"),
        ("{name: pump_off, at: 2}", "has no unit"),
    ):
        with pytest.raises(InputError, match=says):
            check_fits(broken(text), RIG)
    names = {kind.fault_name() for kind in CLASSES}
    assert len(names) == len(CLASSES) == 25


def test_the_page_lists_every_fault() -> None:
    page = (Path(__file__).parents[2] / "docs" / "faults.md").read_text("utf-8")
    page = page.partition("## What notices")[0]
    for kind in CLASSES:
        own = set(kind.model_fields) - {"name", "at", "until", "way", "probability", "most"}
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{kind.fault_name()}`")]
        assert all(f"`{key}`" in row for key in own), row
