"""Numbers carry their units in files and are SI inside."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.model.quantity import UnitError, parse_quantity, to_si, unit_map


@pytest.mark.parametrize(
    ("text", "si", "value"),
    [
        ("75 mm", "m", 0.075),
        ("7MPa", "Pa", 7e6),
        ("11.7 L/min", "m^3/s", 1.95e-4),
        ("40 degC", "degC", 40.0),
        ("313.15 K", "degC", 40.0),
        ("2 K", "delta_degC", 2.0),
        ("-180 deg", "rad", -3.141592653589793),
        ("120.7 bar", "Pa", 12.07e6),
        ("1e3 Hz", "Hz", 1000.0),
        ("6e-7 m^3/(s*V*Pa^0.5)", "m^3/(s*V*Pa^0.5)", 6e-7),
        ("0.5", "", 0.5),
    ],
)
def test_a_quantity_becomes_si(text: str, si: str, value: float) -> None:
    assert parse_quantity(text, si) == pytest.approx(value)


@pytest.mark.parametrize(
    "text", ["", "mm", "75", "75 kg", "75 furlongish", "1e999 m", "5 5 m", "m 5"]
)
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(UnitError):
        parse_quantity(text, "m")


@given(st.floats(-1e9, 1e9), st.sampled_from(["m", "mm", "cm", "inch"]))
def test_the_array_map_agrees_with_the_single_number(value: float, unit: str) -> None:
    scale, offset = unit_map(unit, "m")
    assert scale * value + offset == pytest.approx(to_si(value, unit, "m"))
    assert parse_quantity(f"{value!r} {unit}", "m") == pytest.approx(scale * value, abs=1e-30)


@given(st.text(max_size=60))
def test_any_text_is_a_quantity_or_a_unit_error(text: str) -> None:
    with contextlib.suppress(UnitError):
        assert isinstance(parse_quantity(text, "Pa"), float)
