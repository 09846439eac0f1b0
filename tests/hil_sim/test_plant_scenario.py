"""Somebody writes a scenario file; what makes no sense is refused with line and reason."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_sim.effects.friction import CoulombFriction
from hil_sim.effects.measurement import SensorOffset
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, parse_scenario
from rig.model.parse import InputError
from tests.hil_sim.plant_trace import bench

FILE = """\
description: a tired bench
effects:
  - {name: coulomb_friction, where: joint 2, force: 80 N}
  - {name: external_leakage, where: joint 1 rod, conductance: 2e-12 m^3/(s*Pa)}
  - {name: payload, mass: 6.5 kg}
  - {name: channel_delay, channel: piston_1, time: 2 ms}
  - {name: sensor_offset, channel: oil_temperature, offset: 1.5 delta_degC}
parameters: {b: 200 MPa, M1: 4.6 kg*m^2}
noise: 0.5
"""


def refused(text: str) -> str:
    with pytest.raises(InputError) as caught:
        Plant(bench(), parse_scenario(text, "today.yaml"), 1)
    message = str(caught.value)
    assert "\n" not in message or all(x.startswith("today.yaml:") for x in message.splitlines())
    return message


def test_a_scenario_file_is_read_in_si() -> None:
    found = parse_scenario(FILE, "today.yaml")
    friction, leak, payload, delay, offset = found.effects
    assert isinstance(friction, CoulombFriction)
    assert (friction.joint, friction.force) == (1, 80.0)
    assert (leak.joint, leak.chamber) == (0, "rod")
    assert (payload.joint, payload.place) == (None, "bench")
    assert (delay.place, getattr(delay, "time", 0)) == ("piston_1", pytest.approx(2e-3))
    assert isinstance(offset, SensorOffset)
    assert offset.offset == pytest.approx(1.5)
    assert found.noise == 0.5
    truth = Plant(bench(), found, 1).truth()
    assert (truth["b"], truth["M1"], truth["M2"]) == pytest.approx((200e6, 4.6, 1.27))


def test_nothing_is_wrong_with_the_default() -> None:
    assert Scenario() == parse_scenario("{}", "empty.yaml")
    assert Scenario().effects == ()
    assert Scenario().noise == 1.0


def test_built_in_code_a_scenario_takes_si_numbers() -> None:
    effect = CoulombFriction(name="coulomb_friction", where="joint 1", force=50.0)
    assert Scenario(effects=(effect,), parameters={"b": 2e8}).effects == (effect,)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("force: 80 N", "force: 80", "today.yaml:3: .*force: 80 has no unit"),
        ("force: 80 N", "force: 80 MPa", "today.yaml:3: .*unit 'MPa' is of another dimension"),
        ("force: 80 N", "force: -80 N", "today.yaml:3: .*force: .*greater than 0"),
        ("force: 80 N", "strength: 80 N", "today.yaml:3: .*strength: unknown key"),
        ("coulomb_friction", "coulomb", "today.yaml:3: .*'coulomb'"),
        ("joint 2,", "bench,", "today.yaml:3: .*'bench' is not where .* 'joint I'"),
        ("joint 2,", "joint 2 cap,", "today.yaml:3: .*'joint 2 cap' is not where"),
        ("joint 2,", "joint 7,", "joint 7, but rig 'shinshu-2dof' has 2"),
        ("rod, conductance", "tip, conductance", "today.yaml:4: .*'joint 1 tip' is not where"),
        ("piston_1", "piston_9", "channel 'piston_9', but rig 'shinshu-2dof' measures: spool_1"),
        ("piston_1", "pistol_1", "today.yaml:6: .*unknown channel 'pistol_1'"),
        ("piston_1", "command_1", "today.yaml:6: .*'command_1' is put out, not measured"),
        ("1.5 delta_degC", "1.5", "today.yaml:7: .*1.5 has no unit"),
        ("1.5 delta_degC", "1.5 bar", "today.yaml:7: .*'bar' is of another dimension"),
        ("b: 200 MPa", "b: 200", "today.yaml:8: .*200 has no unit"),
        ("b: 200 MPa", "b: -200 MPa", "parameter b is -2e.08; no bench has that"),
        ("M1: 4.6", "M1: 1.0", "no positive definite mass matrix"),
        ("M1:", "R33:", "scenario parameters: 'R33' is no parameter of a rig with 2"),
        ("b: 200 MPa", "x: 200 MPa", "today.yaml:8: .*'x' is no parameter"),
        ("noise: 0.5", "noise: -1", "today.yaml:9: noise: "),
        ("noise: 0.5", "noisy: 1", "today.yaml:9: noisy: unknown key"),
        ("{name: payload, mass: 6.5 kg}", "payload", "today.yaml:5: "),
        (
            "payload, mass: 6.5 kg",
            "coulomb_friction, where: joint 2, force: 1 N",
            "today.yaml:2: effects: coulomb_friction at joint 2 occurs twice",
        ),
        ("payload, mass: 6.5 kg", "supply_sag", "today.yaml:5: .*at least one of flow"),
    ],
)
def test_what_makes_no_sense_is_refused_with_its_line(old: str, new: str, says: str) -> None:
    text = FILE.replace(old, new, 1)
    assert text != FILE
    message = refused(text)
    assert re.search(says, message), message


def refusal(text: str) -> str | None:
    try:
        parse_scenario(text, "any.yaml")
    except InputError as error:
        return str(error)
    return None


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    message = refusal(text)
    assert message is None or all(x.startswith("any.yaml:") for x in message.splitlines())


@given(
    st.dictionaries(
        st.sampled_from(["name", "where", "channel", "force", "offset", "mass", "time", "x"]),
        st.one_of(
            st.none(),
            st.integers(),
            st.floats(),
            st.sampled_from(["payload", "sensor_offset", "joint 1", "3 N", "1 kg", "piston_1", ""]),
            st.lists(st.integers(), max_size=2),
        ),
        max_size=5,
    )
)
def test_any_effect_is_read_or_refused_by_lines_that_name_the_file(
    effect: dict[str, object],
) -> None:
    body = ", ".join(f"{k}: {v if v is not None else 'null'}" for k, v in effect.items())
    message = refusal(f"effects: [{{{body}}}]")
    assert message is None or all(x.startswith("any.yaml:") for x in message.splitlines())
