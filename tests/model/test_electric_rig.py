"""Somebody describes an electric robot: what a drive gives, where it may go, how it is measured."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.model.parse import InputError, parse_model
from rig.model.rig import ElectricRig, Rig
from rig.runs.rigs import load_bench, load_rig, rig_text

TEXT, _ = rig_text("emps")
ARM, _ = rig_text("electric-2dof")


def refused(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "mine.yaml")
    return str(caught.value)


def test_a_prismatic_joint_is_read_in_its_own_units() -> None:
    rig = load_rig("emps")
    assert isinstance(rig, ElectricRig)
    assert rig.channels == ("position_1", "drive_1")
    assert rig.joints[0].drive.gain == pytest.approx(35.15065)
    assert rig.joints[0].limits.position == pytest.approx((-0.02, 0.28))
    assert (rig.unit_of("position_1"), rig.unit_of("drive_1")) == ("m", "V")
    assert (rig.unit_of_parameter("M1"), rig.unit_of_parameter("Fv1")) == ("kg", "N*s/m")
    assert rig.unit_of_parameter("Fc1") == "N"


def test_revolute_joints_have_radians_and_newton_metres() -> None:
    rig = load_rig("electric-2dof")
    assert isinstance(rig, ElectricRig)
    assert rig.joints[0].limits.position[1] == pytest.approx(2.0943951)
    assert (rig.unit_of("position_2"), rig.unit_of("drive_2")) == ("rad", "A")
    assert (rig.unit_of_parameter("W1"), rig.unit_of_parameter("offset2")) == ("kg*m", "N*m")
    assert rig.inclination == "unknown"
    known = parse_model(Rig, ARM.replace("inclination: unknown", "inclination: 90 deg"), "a")
    assert known.base_angle == pytest.approx(1.5707963)


@pytest.mark.parametrize("name", ["shinshu-2dof", "emps", "electric-2dof"])
def test_a_rig_comes_back_from_plain_data_as_what_it_was(name: str) -> None:
    rig = load_rig(name)
    assert Rig.model_validate(rig.model_dump(mode="json")) == rig


def test_hydraulic_files_need_no_word_about_it() -> None:
    rig = load_rig("shinshu-2dof")
    assert not rig.electric
    assert not isinstance(rig, ElectricRig)
    assert {joint.type for joint in rig.joints} == {"hydraulic"}


def test_what_an_electric_joint_lacks_is_said_when_it_is_asked_for() -> None:
    rig: Rig = load_rig("emps")
    with pytest.raises(InputError, match="'carriage' is electric and has no cylinder"):
        _ = rig.joints[0].cylinder
    with pytest.raises(AttributeError):
        _ = rig.joints[0].nonsense  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="only hydraulic benches are driven"):
        load_bench("emps")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("35.15065 N/V", "35.15065", "mine.yaml:12: joints.0.drive: 35.15065 has no unit"),
        ("35.15065 N/V", "35 N*m/V", "is of another dimension"),
        ("35.15065 N/V", "0 N/V", "drive gain 0 moves nothing"),
        ("[-20 mm, 280 mm]", "[-20 deg, 280 deg]", "joints.0.limits"),
        ("[-20 mm, 280 mm]", "[280 mm, -20 mm]", "lower 0.28 is not below upper -0.02"),
        ("noise: 3 mV", "noise: 3 mm", "sensors"),
        ("kind: prismatic", "kind: screw", "mine.yaml:11: joints.0.kind"),
        ("M1: 100 kg", "M2: 100 kg", "'M2' is no parameter of an electric rig with 1 joint"),
        ("sample_rate", "supply: {pressure: 7 MPa, flow: 1 L/min}\nsample_rate", "neither supply"),
        ("gravity: 0", "inclination: unknown\ngravity: 0", "the slope's pull is a torque_offset"),
        ("bits: 24", "bit: 24", "unknown key"),
    ],
)
def test_a_mistake_is_named_with_its_line(old: str, new: str, said: str) -> None:
    assert old in TEXT
    assert said in refused(TEXT.replace(old, new, 1))


def test_both_types_in_one_rig_are_refused_for_now() -> None:
    assert "both types" in refused(ARM.replace("type: electric", "type: hydraulic", 1))


def test_a_prismatic_joint_stands_alone() -> None:
    text = ARM.split("nominal:")[0].replace("kind: revolute", "kind: prismatic", 1)
    text = text.replace("gain: 3.2 N*m/A", "gain: 3.2 N/A")
    first, rest = "{position: [-1 m, 1 m], speed: 8 m/s, drive: 40 A}", "limits: *limits"
    text = text.replace("{position: [-120 deg, 120 deg], speed: 8 rad/s, drive: 40 A}", first)
    text = text.replace(rest, "limits: {position: [-1 rad, 1 rad], speed: 8 rad/s, drive: 40 A}")
    text = text.replace("[-200 deg, 200 deg]", "[-2 m, 2 m]").replace("0.01 mrad", "1 um")
    assert "a prismatic joint is supported alone" in refused(text)


def test_the_documented_rig_is_one(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "electric.md").read_text()
    (tmp_path / "arm.yaml").write_text(page.split("```yaml\n", 1)[1].split("```", 1)[0])
    assert load_rig(tmp_path / "arm.yaml").electric
