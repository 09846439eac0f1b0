"""A person describes a bench in YAML; what cannot be built is refused with line and reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig

SHIPPED = Path(rig.__file__).parent / "shipped" / "shinshu-2dof.yaml"
TEXT = SHIPPED.read_text()


def line_of(fragment: str, text: str = TEXT) -> int:
    return text[: text.index(fragment)].count("\n") + 1


def refused(old: str, new: str) -> str:
    text = TEXT.replace(old, new, 1)
    assert text != TEXT
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "bench.yaml")
    message = str(caught.value)
    assert all(line.startswith("bench.yaml:") for line in message.splitlines())
    return message


def test_the_shipped_bench_is_the_one_of_the_notes() -> None:
    bench = parse_model(Rig, TEXT, "shinshu")
    assert bench.supply.pressure == pytest.approx(7e6)
    assert bench.supply.flow == pytest.approx(11.7e-3 / 60)
    boom, arm = bench.joints
    assert boom.cylinder.stroke == pytest.approx(0.075)
    assert (boom.cylinder.cap_area, boom.cylinder.rod_area) == pytest.approx((7e-4, 5.4e-4))
    assert (boom.cylinder.cap_pipe_volume, arm.cylinder.cap_pipe_volume) == pytest.approx(
        (7.9e-5, 6.3e-5)
    )
    assert arm.linkage.offset == pytest.approx(-np.pi)
    assert bench.channels[:4] == ("spool_1", "piston_1", "cap_pressure_1", "rod_pressure_1")
    assert bench.recorded[-2:] == ("command_1", "command_2")


def test_a_bench_survives_being_stored_with_a_run() -> None:
    bench = parse_model(Rig, TEXT, "shinshu")
    assert Rig.model_validate_json(bench.model_dump_json()) == bench


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("watchdog: 0.5 s", "watchdog: 100 s", "watchdog 100 s: a device takes 0.02 s to 10 s"),
        ("watchdog: 0.5 s", "watchdog: 10 ms", "watchdog 0.01 s: a device takes 0.02 s to 10 s"),
        ("timeout: 1 s", "timeout: 1 h", "wire.timeout: timeout 3600 s: expected at most 10 s"),
        (
            "pressure: [-0.2 MPa, 9 MPa]",
            "pressure: [-0.2 MPa, 12 MPa]",
            "joint 'boom': limits pressure up to 12 MPa can never be exceeded by a reading: the "
            "range of sensors chamber_pressure ends at 10 MPa",
        ),
        ("wire:", "limits: {supply_pressure: [1 MPa, 15 MPa]}\nwire:", "range ends at 1e+07"),
        ("wire:", "limits: {supply_pressure: [1 MPa, 8]}\nwire:", "write one beside the number"),
        ("wire:", "limits: {oil_temperature: [60 degC, 10 degC]}\nwire:", "is not below upper"),
        ("wire:", "limits: {oil_pressure: [1 MPa, 8 MPa]}\nwire:", "oil_pressure"),
    ],
)
def test_a_limit_that_could_not_protect_is_refused(old: str, new: str, expected: str) -> None:
    assert expected in refused(old, new)


def test_a_bench_in_a_horizontal_plane_has_no_gravity() -> None:
    text = TEXT.replace("gravity: 9.8 m/s^2", "gravity: 0 m/s^2")
    assert parse_model(Rig, text, "bench.yaml").gravity == 0.0


def test_limits_of_the_whole_bench_are_optional_and_have_units() -> None:
    text = TEXT.replace("wire:", "limits: {oil_temperature: [283.15 K, 60 degC]}\nwire:", 1)
    bench = parse_model(Rig, text, "bench.yaml")
    assert bench.limits.oil_temperature == pytest.approx((10.0, 60.0))
    assert bench.limits.supply_pressure is None
    assert Rig.model_validate_json(bench.model_dump_json()) == bench


@pytest.mark.parametrize(
    ("old", "new", "fragment", "expected"),
    [
        ("stroke: 75 mm", "stroke: 75 kg", "stroke: 75", "expected one like 'm'"),
        ("stroke: 75 mm", "stroke: 75", "stroke: 75", "write one beside the number"),
        ("pressure: 7 MPa", "pressure: seven", "supply:", "expected one like '1 Pa'"),
        ("flow: 11.7 L/min", "flow: 11.7 L/fortnite", "supply:", "unknown unit"),
        ("pressure: 7 MPa", "pressure: 160 Pa", "supply:", "greater than or equal to 100000"),
        ("gravity: 9.8", "gravity: 981", "gravity:", "less than or equal to 30"),
        ("density: 860 kg", "density: 860 g", "oil:", "greater than or equal to 500"),
        ("temperature: 40 degC", "temperature: 40 K", "oil:", "greater than or equal to -60"),
        ("name: arm", "name: boom", "joints", "joints 1 and 2 are both named 'boom'"),
        ("  Fv1: 50", "  Fv1: -50", "nominal:", "expected 0 or more"),
        ("gravity:", "gravitas:", "gravity:", "unknown key"),
        ("rod_area: 5.4e-4", "rod_area: 9.4e-4", "cylinder: &cylinder", "exceeds cap_area"),
        ("mid_length: 0.30 m", "mid_length: 0.20 m", "- name: boom", "close a triangle"),
        ("  M1: 5.00", "  M7: 5.00", "nominal:", "M7"),
        ("  M1: 5.00", "  M1: -5.00", "nominal:", "'M1' is -5.00 kg*m^2; expected greater than 0"),
        ("  b: 250 MPa", "  b: 0 MPa", "nominal:", "'b' is 0 MPa; expected greater than 0"),
        ("name: boom", "name: [boom", "    link_length: 0.5 m", "not valid YAML"),
        (
            "  skew: 10 us",
            "  calibrations: {cap_pressure_1: {date: 2026-13-01, serial: A}}",
            "  skew: 10 us",
            "'2026-13-01' cannot be read (month must be in 1..12)",
        ),
        (
            "description: Two",
            'description: "\\U00110000" # Two',
            "description: Two",
            "not valid YAML: chr() arg not in range",
        ),
        (
            "spool_gain: 0.1",
            "spool_gain: yes",
            "spool_gain:",
            "spool_gain: expected a number, found",
        ),
        ("command_bits: 12", "command_bits: yes", "command_bits:", "found True"),
        ("bits: 16", "bits: 64", "spool: {range", "less than or equal to 16"),
        ("name: shinshu-2dof", "name: " + 81 * "x", "name: shinshu", "found 'xxxxx"),
        ("sample_rate: 1 kHz", "sample_rate: 1 MHz", "sample_rate:", "less than or equal to 1000"),
    ],
)
def test_a_bench_that_cannot_be_built_is_refused_with_its_line(
    old: str, new: str, fragment: str, expected: str
) -> None:
    message = refused(old, new)
    assert expected in message
    line = int(message.split(":")[1])
    assert abs(line - line_of(fragment)) <= 1, message


def test_every_error_of_a_file_is_listed_with_line_key_found_and_expected() -> None:
    text = TEXT
    wrong = {
        "gravity: 9.8 m/s^2": "gravitas: 9.8 m/s^2",
        "stroke: 75 mm": "stroke: 75 kg",
        "bits: 16, noise: 0.2 mV": "bits: 64, noise: 0.2 mV",
        "watchdog: 0.5 s": "watchdog: soon",
        "flow: 11.7 L/min": "flow: 11.7",
    }
    for old, new in wrong.items():
        text = text.replace(old, new, 1)
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "bench.yaml")
    lines = str(caught.value).splitlines()
    said = [
        ("gravitas", "gravitas: unknown key"),
        ("flow: 11.7", "supply.flow: 11.7 has no unit; write one beside the number"),
        ("stroke: 75 kg", "cylinder.stroke: unit 'kg' is of another dimension"),
        ("bits: 64", "sensors.spool.bits: expected less than or equal to 16, found 64"),
        ("watchdog: soon", "'soon' is not a number with a unit"),
    ]
    assert len(lines) == len(said), lines  # a cylinder that two joints share is wrong once
    for line, (fragment, says) in zip(lines, said, strict=True):
        assert line.startswith(f"bench.yaml:{line_of(fragment, text)}: ")
        assert says in line


def test_a_file_of_another_kind_is_refused_with_a_bounded_list() -> None:
    text = "\n".join(f"key{k}: {k}" for k in range(500))
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "bench.yaml")
    lines = str(caught.value).splitlines()
    assert len(lines) < 40
    assert lines[-1].startswith("bench.yaml: and ")


def test_a_key_written_twice_is_refused() -> None:
    assert "occurs twice" in refused("gravity: 9.8 m/s^2", "gravity: 9.8 m/s^2\ngravity: 1 m/s^2")


@given(st.text(max_size=200))
def test_any_text_at_all_is_read_or_refused_in_one_line(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "x.yaml")
    assert str(caught.value).startswith("x.yaml:")


@pytest.mark.parametrize("bad", ["- 1\n- 2\n", "just words", "joints: &a [*a]", "? [a]\n: 1", "{}"])
def test_yaml_that_is_no_bench_is_refused(bad: str) -> None:
    with pytest.raises(InputError):
        parse_model(Rig, bad, "x.yaml")


@pytest.mark.parametrize("one", ["[{}]", "{{<<: [{}]}}"])
def test_aliases_of_aliases_are_refused_with_their_line_before_they_are_written_out(
    one: str,
) -> None:
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{k}: &a{k} {one.format(','.join(9 * [f'*a{k - 1}']))}" for k in range(1, 30)]
    with pytest.raises(InputError, match=r"^x.yaml:6: \d+ values once its aliases"):
        parse_model(Rig, "\n".join(lines), "x.yaml")


def with_tolerances(block: str) -> str:
    return TEXT.replace("wire:", f"tolerances: {block}\nwire:", 1)


def test_tolerances_have_units_and_are_stored_with_a_run() -> None:
    text = with_tolerances("{area: 0.3 %, volume: 5 %, pin: 0.2 mm}")
    bench = parse_model(Rig, text, "bench.yaml")
    assert bench.tolerances is not None
    assert bench.tolerances.area == pytest.approx(0.003)
    assert bench.tolerances.volume == pytest.approx(0.05)
    assert bench.tolerances.pin == pytest.approx(2e-4)
    assert bench.tolerances.mid_length == 0.0
    assert Rig.model_validate_json(bench.model_dump_json()) == bench
    sigma = {number.name: number.sigma for number in bench.uncertain_numbers}
    assert len(sigma) == 12  # two areas, two volumes, two pins of each joint; no mid length
    assert sigma["rod_area of joint 2"] == pytest.approx(0.003 * 5.4e-4)
    assert sigma["cap_pipe_volume of joint 1"] == pytest.approx(0.05 * 7.9e-5)
    assert sigma["arm_pin of joint 1"] == pytest.approx(2e-4)


def test_a_bench_without_tolerances_is_stored_as_ever() -> None:
    bench = parse_model(Rig, TEXT, "bench.yaml")
    assert bench.uncertain_numbers == ()
    assert "tolerances" not in bench.model_dump(mode="json")
    assert "tolerances" not in bench.model_dump_json()


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        ("{pins: 0.2 mm}", "tolerances.pins: unknown key"),
        ("{pin: -0.2 mm}", "tolerances.pin: expected greater than or equal to 0, found -0.0002"),
        ("{area: -1 %}", "tolerances.area: expected greater than or equal to 0, found -0.01"),
        ("{area: 120 %}", "tolerances.area: expected less than 0.2, found 1.2"),
        ("{pin: 0.2}", "tolerances.pin: 0.2 has no unit; write one beside the number"),
        ("{area: 3 mm^2}", "tolerances.area: unit 'mm^2' is of another dimension"),
        ("{mid_length: 5 cm}", "mid_length 50 mm: with mid_length of joint 2 larger by it"),
    ],
)
def test_a_tolerance_that_makes_no_sense_is_refused_with_its_line(
    block: str, expected: str
) -> None:
    text = with_tolerances(block)
    with pytest.raises(InputError) as caught:
        parse_model(Rig, text, "bench.yaml")
    (line,) = str(caught.value).splitlines()
    assert expected in line
    assert line.startswith(f"bench.yaml:{line_of('tolerances:', text)}: tolerances")


def test_an_electric_rig_has_no_geometry_with_tolerances() -> None:
    text = SHIPPED.with_name("electric-2dof.yaml").read_text()
    with pytest.raises(InputError, match=r"tolerances: .* neither cylinders nor linkages"):
        parse_model(Rig, text + "\ntolerances: {area: 1 %}\n", "arm.yaml")
