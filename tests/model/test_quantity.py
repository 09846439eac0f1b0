"""Numbers carry their units in files and are SI inside."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.model import units
from rig.model.quantity import UnitError, map_by_pint, parse_quantity, to_si, unit_map
from rig.model.units import (
    LIMITS,
    READINGS,
    RESIDUALS,
    RESULTS,
    DisplayUnit,
    differs,
    linear_map,
    measure,
    plain,
    with_interval,
)

SHIPPED = ("boom-1dof", "digger-3dof", "electric-2dof", "emps", "shinshu-2dof", "uia-crane")


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


@pytest.mark.parametrize(
    ("text", "hertz"),
    [
        ("60 rpm", 1.0),
        ("3000 revolution/minute", 50.0),
        ("1 turn/s", 1.0),
        ("360 deg/s", 1.0),
        ("5 rad/s", 0.7957747),
        ("0.5 krad/s", 79.57747),
        ("600 1/min", 10.0),
        ("2 1/s", 2.0),
    ],
)
def test_an_angle_per_time_is_a_frequency_of_its_turns(text: str, hertz: float) -> None:
    assert parse_quantity(text, "Hz") == pytest.approx(hertz, rel=1e-6)


ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "turn": math.tau, "revolution": math.tau}
TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "hour": 3600.0}


@given(
    st.floats(1e-6, 1e6),
    st.sampled_from(sorted(ANGLES)),
    st.sampled_from(sorted(TIMES)),
    st.sampled_from(["{0}/{1}", "1/{1}*{0}", "{0}*{1}^-1", "{0} / ({1})"]),
)
def test_a_body_that_turns_so_fast_has_that_frequency(
    number: float, angle: str, time: str, form: str
) -> None:
    found = parse_quantity(f"{number!r} {form.format(angle, time)}", "Hz")
    assert found == pytest.approx(number * ANGLES[angle] / TIMES[time] / math.tau)


@pytest.mark.parametrize("text", ["1 rad^2/s", "1 1/(rad*s)", "1 rad"])
def test_no_frequency_is_refused(text: str) -> None:
    with pytest.raises(UnitError, match="expected one like 'Hz'"):
        parse_quantity(text, "Hz")


@given(st.text(max_size=60))
def test_any_text_is_a_quantity_or_a_unit_error(text: str) -> None:
    with contextlib.suppress(UnitError):
        assert isinstance(parse_quantity(text, "Pa"), float)


NAMES = sorted(units._NAMES)
WANTED = (
    "m", "m^2", "m^3", "rad", "m/s", "m/s^2", "Pa", "Pa/s", "m^3/s", "Hz", "s", "V", "kg/m^3",
    "degC", "delta_degC", "", "N*m/rad", "m^3/(s*V*Pa^0.5)", "kg*m^2", "N*s/m",
)  # fmt: skip


def by_pint(unit: str, si: str) -> tuple[float, float] | None:
    try:
        return map_by_pint(unit, si)
    except UnitError:
        return None


def assert_as_pint(unit: str, si: str) -> None:
    """Where our own table answers, pint answers the same."""
    found = linear_map(unit, si)
    if found is not None:
        expected = by_pint(unit, si)
        assert expected is not None, (unit, si)
        assert found == pytest.approx(expected, rel=1e-14, abs=1e-12), (unit, si)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_of_the_own_table_is_pints(name: str) -> None:
    for si in (
        "m",
        "kg",
        "s",
        "A",
        "degC",
        "delta_degC",
        "Hz",
        "N",
        "Pa",
        "J",
        "W",
        "V",
        "m^3",
        "",
    ):
        assert_as_pint(name, si)


factor = st.tuples(st.sampled_from(NAMES), st.sampled_from(["", "^2", "**3", "^-1", "^0.5"])).map(
    "".join
)
product = st.lists(factor, min_size=1, max_size=3).flatmap(
    lambda parts: st.lists(
        st.sampled_from(["*", "/", " * ", " / "]), min_size=len(parts) - 1, max_size=len(parts) - 1
    ).map(lambda signs: "".join(p + s for p, s in zip(parts, [*signs, ""], strict=True)))
)
unit_text = st.one_of(product, st.tuples(product, product).map(lambda t: f"{t[0]}/({t[1]})"))


@given(unit_text, st.sampled_from(WANTED))
def test_a_made_up_unit_is_what_pint_makes_of_it(unit: str, si: str) -> None:
    assert_as_pint(unit, si)


@given(unit_text, st.sampled_from(WANTED))
def test_a_unit_known_to_be_of_another_dimension_is_refused_by_pint_too(unit: str, si: str) -> None:
    if differs(unit, si):
        assert by_pint(unit, si) is None


@given(unit_text)
def test_a_made_up_unit_has_pints_size_in_its_own_si_units(unit: str) -> None:
    known = measure(unit)
    if known is not None and all(float(p).is_integer() for p in known.powers):
        names = ("m", "kg", "s", "A", "delta_degC")
        si = "*".join(f"{n}^{p:g}" for n, p in zip(names, known.powers, strict=True) if p)
        assert_as_pint(unit, si)


@given(st.text(alphabet="mkgsPaVrdeC*/^()123. -bin", max_size=12), st.sampled_from(WANTED))
def test_any_text_is_answered_as_pint_answers_or_left_to_it(unit: str, si: str) -> None:
    assert_as_pint(unit, si)


def test_the_shipped_rigs_are_read_without_pint() -> None:
    code = (
        "import sys; from rig.runs.rigs import load_rig\n"
        f"for name in {SHIPPED!r}: load_rig(name)\n"
        "assert 'pint' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_shipped_protocols_are_read_without_pint() -> None:
    code = (
        "import sys; from protocols.files import library\n"
        "for name in library.shipped_names(): library.load(name)\n"
        "assert 'pint' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("table", [READINGS, LIMITS, RESIDUALS, RESULTS])
def test_a_display_unit_scales_as_pint_does(table: dict[str, DisplayUnit]) -> None:
    for si, shown in table.items():
        if "√" not in shown.text:
            unit = {"°": "deg", "°C": "degC"}.get(shown.text, shown.text)
            assert shown.scale * map_by_pint(unit, si)[0] == pytest.approx(1.0, rel=1e-12), si


@pytest.mark.parametrize(
    ("value", "half", "shown"),
    [
        (128.4, 20.3, "128 ± 20"),
        (1.00002, 0.00204, "1.0000 ± 0.0020"),
        (1.53e-12, 4e-14, "1.530e-12 ± 0.040e-12"),
        (-37.6, 3.9, "-37.6 ± 3.9"),
        (99.96, 9.97, "100 ± 10"),
        (128.0, 412.0, "130 ± 410"),
        (3.2, 4e11, "0.0 ± 4.0e11"),
        (5e5, 9960.0, "5.00e5 ± 0.10e5"),
        (99999.96, 0.5, "99999.96 ± 0.50"),
        (0.252, 0.0, "0.252"),
        (0.252, math.nan, "0.252"),
        (0.252, math.inf, "0.252 ± ∞"),
        (-0.01, 5.0, "0.0 ± 5.0"),
    ],
)
def test_a_value_has_the_decimals_of_its_interval(value: float, half: float, shown: str) -> None:
    assert with_interval(value, half) == shown
    assert with_interval(value, half, "N") == f"{shown} N"


@given(st.floats(1e-14, 1e14), st.floats(1e-4, 1e4), st.sampled_from((-1.0, 1.0)))
def test_what_is_shown_of_an_interval_is_its_value(size: float, times: float, sign: float) -> None:
    """To the last digit shown; half the interval has two digits, wherever the point stands."""
    value, half = sign * size, times * size
    shown, _, width = with_interval(value, half).partition(" ± ")
    assert float(width) == pytest.approx(half, rel=0.051)
    assert abs(float(shown) - value) <= 0.051 * half
    assert ("e" in width) == (not 1e-3 <= max(size, half) < 1e5)


@given(st.floats(1e-3, 99_000.0), st.integers(2, 4))
def test_no_number_of_usual_size_is_written_with_an_exponent(value: float, digits: int) -> None:
    assert "e" not in plain(value, digits)
    assert float(plain(value, digits)) == float(f"{value:.{digits}g}")
