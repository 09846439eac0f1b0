"""Quantities with units in files, plain SI floats in code.

A model field is declared as ``stroke: Length``. In a file it must have its unit (``75 mm``) and
becomes a float in SI; in code it is a float in SI. The difference is the validation context that
`rig.model.parse` passes: `FROM_FILE`.
"""

from __future__ import annotations

import functools
import math
import re
from typing import Annotated, Any, cast

from pydantic import BeforeValidator, ValidationInfo, WithJsonSchema

from rig.model.units import differs, linear_map

FROM_FILE: dict[str, bool] = {"from_file": True}

# One number, then a unit: "7 MPa", "-1.5e-3 m^2", "40 degC".
_QUANTITY = re.compile(
    r"^\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*?)\s*$"
)


class UnitError(ValueError):
    """A quantity that cannot be read: no number, no unit, or a unit of another dimension."""


@functools.cache
def _registry() -> Any:
    import pint  # noqa: PLC0415 - loads slowly, and files seldom need it

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=None)


@functools.cache
def unit_map(unit: str, si: str) -> tuple[float, float]:
    """Return (scale, offset) with value_si = scale * value + offset.

    Raises UnitError for an unknown unit or one of another dimension.
    """
    known = linear_map(unit, si)
    if known is None and differs(unit, si):
        raise _other_dimension(unit, si)
    return known or map_by_pint(unit, si)


def _other_dimension(unit: str, si: str) -> UnitError:
    return UnitError(
        f"unit {unit or 'dimensionless'!r} is of another dimension; "
        f"expected one like {si or 'dimensionless'!r}"
    )


def map_by_pint(unit: str, si: str) -> tuple[float, float]:
    """Return (scale, offset) as `unit_map`, for any unit that pint knows; raises UnitError.

    To pint a radian is 1 and a turn 2 pi, so that 1 rad/s would be 1 Hz: an angle per time is
    divided by 2 pi to become a frequency.
    """
    registry = _registry()
    text = unit or "dimensionless"
    target = si or "dimensionless"
    try:
        parsed = registry.Unit(text)
    except Exception as error:  # pint raises tokenizer, attribute and type errors alike
        raise UnitError(f"unknown unit {unit!r}; expected one like {target!r}") from error
    try:
        zero = registry.Quantity(0.0, parsed).to(target).magnitude
        unit_size = registry.Quantity(1.0, parsed).to(target).magnitude
        angles = registry.get_root_units(parsed)[1]._units.get("radian", 0) if si == "Hz" else 0
    except Exception as error:  # of another dimension, or without a conversion
        raise _other_dimension(unit, si) from error
    if angles not in (0, 1):
        raise _other_dimension(unit, si)
    return float(unit_size - zero) / math.tau**angles, float(zero)


def to_si(value: float, unit: str, si: str) -> float:
    """Convert a number in `unit` to the SI unit `si` (a float; raises UnitError)."""
    scale, offset = unit_map(unit, si)
    return scale * value + offset


def parse_quantity(text: str, si: str) -> float:
    """Read ``"75 mm"`` as a float in the SI unit `si`; raises UnitError."""
    match = _QUANTITY.match(text)
    if match is None:
        raise UnitError(f"{text!r} is not a number with a unit; expected one like '1 {si}'")
    unit = match["unit"]
    if not unit and si:
        raise UnitError(f"{text!r} has no unit; write one beside the number, like '{text} {si}'")
    value = to_si(float(match["number"]), unit, si)
    if not math.isfinite(value):
        raise UnitError(f"{text!r} is not a finite number")
    return value


def is_from_file(info: ValidationInfo) -> bool:
    """Return whether a model is read from a file that a person wrote, not from a run's own."""
    return bool(info.context and cast(dict[str, bool], info.context).get("from_file"))


def _validator(si: str) -> BeforeValidator:
    def validate(value: Any, info: ValidationInfo) -> Any:
        from_file = is_from_file(info)
        if isinstance(value, bool) or value is None:
            raise UnitError(f"{value!r} is not a number with a unit; expected one like '1 {si}'")
        if isinstance(value, str):
            return parse_quantity(value, si)
        if from_file and si:
            raise UnitError(f"{value!r} has no unit; write one beside the number, like '1 {si}'")
        if not math.isfinite(value):
            raise UnitError(f"{value!r} is not a finite number")
        return float(value)

    return BeforeValidator(validate)


def shown_in_schema(si: str) -> WithJsonSchema:
    """Return the JSON schema of a quantity in `si`: a text with its unit."""
    if not si:
        return WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string"}]})
    return WithJsonSchema({"type": "string", "examples": [f"1 {si}"]})


Length = Annotated[float, _validator("m"), shown_in_schema("m")]
Area = Annotated[float, _validator("m^2"), shown_in_schema("m^2")]
Volume = Annotated[float, _validator("m^3"), shown_in_schema("m^3")]
Angle = Annotated[float, _validator("rad"), shown_in_schema("rad")]
Speed = Annotated[float, _validator("m/s"), shown_in_schema("m/s")]
Acceleration = Annotated[float, _validator("m/s^2"), shown_in_schema("m/s^2")]
Pressure = Annotated[float, _validator("Pa"), shown_in_schema("Pa")]
PressureRate = Annotated[float, _validator("Pa/s"), shown_in_schema("Pa/s")]
Flow = Annotated[float, _validator("m^3/s"), shown_in_schema("m^3/s")]
Frequency = Annotated[float, _validator("Hz"), shown_in_schema("Hz")]
Time = Annotated[float, _validator("s"), shown_in_schema("s")]
Voltage = Annotated[float, _validator("V"), shown_in_schema("V")]
Density = Annotated[float, _validator("kg/m^3"), shown_in_schema("kg/m^3")]
Temperature = Annotated[float, _validator("degC"), shown_in_schema("degC")]
TemperatureDifference = Annotated[float, _validator("delta_degC"), shown_in_schema("delta_degC")]
Ratio = Annotated[float, _validator(""), shown_in_schema("")]
