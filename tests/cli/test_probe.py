"""An operator looks at the bench before anything moves, and stops what somebody else began."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers import make_driver, wire_at
from drivers.base import OFF, OutputLaw, SampleBlock
from rig.bench.probe import GOOD, pressurised, readings, unknown_pressures
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.cli.bench import bramah_here, simulated

RIG = "shinshu-2dof"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with simulated_bench(RIG, seed=4) as endpoint:
        yield endpoint


def test_probe_shows_every_channel_with_its_codes_and_moves_nothing(
    endpoint: str, tmp_path: Path
) -> None:
    out = tmp_path / "probe.json"
    shown = bramah_here("probe", "--rig", RIG, "--endpoint", endpoint, "--json", out)
    assert shown.returncode == 0, shown.stderr
    found = {one["channel"]: one for one in json.loads(out.read_text())}
    assert tuple(found) == load_rig(RIG).channels
    assert all(one["mark"] == GOOD for one in found.values())
    assert found["supply_pressure"]["mean"] == pytest.approx(7e6, rel=0.02)
    low, high = found["piston_1"]["codes"]
    assert low <= 32768 <= high or abs(low - 32768) < 200  # mid-stroke is the middle of 16 bits
    assert "still under pressure: joint 1 cap" in shown.stdout
    supply = next(line for line in shown.stdout.splitlines() if line.startswith("supply_pressure"))
    assert float(supply.split()[1]) == pytest.approx(7.0, rel=0.02)
    assert " MPa " in supply


def test_a_program_reads_json_alone_while_chambers_are_under_pressure(endpoint: str) -> None:
    shown = bramah_here("probe", "--rig", RIG, "--endpoint", endpoint, "--json", "-")
    assert shown.returncode == 0, shown.stderr
    assert {one["channel"] for one in json.loads(shown.stdout)} == set(load_rig(RIG).channels)
    assert "still under pressure: joint 1 cap" in shown.stderr


def test_stop_zeroes_what_another_host_has_put_out(endpoint: str) -> None:
    rig = load_rig(RIG)
    other = make_driver(wire_at(endpoint, rig.wire), rig)
    other.connect()
    other.start()
    other.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
    assert other.read_block().data[:, 10].min() > 0.4
    stopped = bramah_here("stop", "--rig", RIG, "--endpoint", endpoint)
    assert stopped.returncode == 0, stopped.stderr
    assert stopped.stdout.startswith("outputs at zero, confirmed by the device")
    assert "another client has control" in stopped.stderr
    assert np.all(other.read_block().data[:, 10:] == 0.0)
    other.close()


def test_what_could_not_be_confirmed_is_said_first() -> None:
    gone = bramah_here("stop", "--rig", RIG, "--endpoint", "modbus-tcp://127.0.0.1:9")
    assert gone.returncode == 4
    assert "outputs not confirmed at zero" in gone.stderr
    assert "emergency stop" in gone.stderr


def test_pressure_that_the_rig_cannot_let_out_is_named(endpoint: str) -> None:
    left = bramah_here("depressurise", "--rig", RIG, "--endpoint", endpoint)
    assert left.returncode == 1
    assert "no way to release the pressure" in left.stderr
    assert "supply 7.0" in left.stderr


def block(rig: Rig, **values: float) -> SampleBlock:
    data = np.zeros((10, len(rig.recorded)))
    data[:, rig.channels.index("supply_pressure")] = 7e6
    data[:, rig.channels.index("oil_temperature")] = 40.0
    for name, value in values.items():
        data[:, rig.channels.index(name)] = value
    low = np.array([rig.sensors.of(n.rsplit("_", 1)[0] if n[-1].isdigit() else n).range[0]
                    for n in rig.channels])  # fmt: skip
    return SampleBlock(0, 0, data, data[:, : len(rig.channels)] <= low, 0, False)


@pytest.mark.parametrize(
    ("channel", "value", "says"),
    [
        ("cap_pressure_1", 7.6e6, "above the supply pressure of 7.00 MPa"),
        ("rod_pressure_2", -0.9e6, "below zero|end of its converter"),
        ("piston_1", -0.04, "end of its converter's range"),
        ("oil_temperature", float("nan"), "not a number"),
    ],
)
def test_what_is_not_plausible_is_marked(channel: str, value: float, says: str) -> None:
    rig = load_rig(RIG)
    found = {one.channel: one for one in readings(block(rig, **{channel: value}), rig)}
    assert found.pop(channel).mark != GOOD
    assert {one.mark for one in found.values()} == {GOOD}
    again = {one.channel: one for one in readings(block(rig, **{channel: value}), rig)}
    assert any(word in again[channel].mark for word in says.split("|"))


def test_a_bench_without_pressure_says_nothing_of_it() -> None:
    rig = load_rig(RIG)
    empty = readings(block(rig, supply_pressure=0.0), rig)
    assert pressurised(empty) == unknown_pressures(empty) == []


def test_a_chamber_that_no_sensor_shows_is_not_taken_for_an_empty_one() -> None:
    rig = load_rig(RIG)
    low = rig.sensors.chamber_pressure.range[0]
    blind = block(rig, supply_pressure=0.0, cap_pressure_1=float("nan"), rod_pressure_2=low)
    found = readings(blind, rig)
    assert pressurised(found) == []
    nan, broken = unknown_pressures(found)
    assert nan == "joint 1 cap (not a number)"
    assert broken.startswith("joint 2 rod (at the end of its converter's range: a broken wire")


def test_a_broken_wire_is_named_where_pressures_are_listed(tmp_path: Path) -> None:
    faults = "[{name: broken_wire, channel: cap_pressure_1, end: low, at: 0 s}]"
    scenario = tmp_path / "broken.yaml"
    scenario.write_text(f"faults: {faults}\n")
    with simulated("--scenario", str(scenario)) as (endpoint, _):
        at = ("--rig", RIG, "--endpoint", endpoint)
        stopped, left = bramah_here("stop", *at), bramah_here("depressurise", *at)
    assert "; pressure not known, shinshu-2dof" in stopped.stdout
    assert "pressure not known: joint 1 cap (at the end of its converter's range" in left.stderr
    assert left.returncode == 1
