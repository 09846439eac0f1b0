"""Units of files and displays, in tables: pint takes a third of a second to load.

Products, quotients and powers of them with SI prefixes are understood; anything else is left to
pint (`rig.model.quantity`), with whose results these agree. The tables at the end map an SI
quantity to its display unit: on the screen, as a limit, as a result, as a residual.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Final

_PREFIXES: Final = {
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
}
_TOKEN: Final = re.compile(r"\s*(\*\*|[*/^()]|[+-]?\d+\.?\d*(?:[eE][+-]?\d+)?|[A-Za-zµ_]+)\s*")
_ANGLE: Final = re.compile(r"rad|deg")
_ZERO_CELSIUS: Final = 273.15  # [K]
_PLAIN_FROM, _PLAIN_BELOW = 1e-3, 1e5  # numbers that are written without exponent


@dataclass(frozen=True)
class Measure:
    """A unit's size in SI and its powers of metre, kilogram, second, ampere and kelvin."""

    size: float
    powers: tuple[float, float, float, float, float]

    def times(self, other: Measure, power: float = 1.0) -> Measure:
        """Return this unit times another to a power."""
        powers = [a + power * b for a, b in zip(self.powers, other.powers, strict=True)]
        a, b, c, d, e = powers
        return Measure(self.size * other.size**power, (a, b, c, d, e))


ONE: Final = Measure(1.0, (0, 0, 0, 0, 0))
_METRIC: Final = {  # these take prefixes
    "m": Measure(1.0, (1, 0, 0, 0, 0)),
    "g": Measure(1e-3, (0, 1, 0, 0, 0)),
    "s": Measure(1.0, (0, 0, 1, 0, 0)),
    "A": Measure(1.0, (0, 0, 0, 1, 0)),
    "K": Measure(1.0, (0, 0, 0, 0, 1)),
    "Hz": Measure(1.0, (0, 0, -1, 0, 0)),
    "N": Measure(1.0, (1, 1, -2, 0, 0)),
    "Pa": Measure(1.0, (-1, 1, -2, 0, 0)),
    "bar": Measure(1e5, (-1, 1, -2, 0, 0)),
    "J": Measure(1.0, (2, 1, -2, 0, 0)),
    "W": Measure(1.0, (2, 1, -3, 0, 0)),
    "V": Measure(1.0, (2, 1, -3, -1, 0)),
    "L": Measure(1e-3, (3, 0, 0, 0, 0)),
    "rad": ONE,
}
_OTHER: Final = frozenset({"Gs"})  # gauss
_PLAIN: Final = {
    "": ONE,
    "dimensionless": ONE,
    "deg": Measure(math.pi / 180.0, ONE.powers),
    "min": Measure(60.0, (0, 0, 1, 0, 0)),
    "inch": Measure(0.0254, (1, 0, 0, 0, 0)),
    "delta_degC": Measure(1.0, (0, 0, 0, 0, 1)),
}
_NAMES: Final = {
    **{prefix + name: Measure(size * unit.size, unit.powers)
       for prefix, size in _PREFIXES.items() for name, unit in _METRIC.items()
       if prefix + name not in _OTHER},
    **_METRIC,
    **_PLAIN,
}  # fmt: skip


def linear_map(unit: str, si: str) -> tuple[float, float] | None:
    """Return (scale, offset) of value_si = scale value + offset; None if pint is needed."""
    unit, si = unit.strip(), si.strip()
    if si == "degC":
        return {"degC": (1.0, 0.0), "K": (1.0, -_ZERO_CELSIUS)}.get(unit)
    if si == "Hz" and _ANGLE.search(unit):  # an angle per time: 2 pi of it to a period
        return None
    source, target = measure(unit), measure(si)
    if source is None or target is None or source.powers != target.powers:
        return None
    return source.size / target.size, 0.0


def differs(unit: str, si: str) -> bool:
    """Return whether a unit is known to be of another dimension than `si`."""
    given, target = measure(unit.strip()), measure(si.strip())
    return given is not None and target is not None and given.powers != target.powers


def measure(text: str) -> Measure | None:
    """Return the measure of a unit's text; None for an unknown unit or form."""
    if text in _NAMES:
        return _NAMES[text]
    tokens, end = [], 0
    while end < len(text):
        match = _TOKEN.match(text, end)
        if match is None:
            return None
        tokens.append(match[1])
        end = match.end()
    rest = iter([*tokens, ""])
    try:
        return _product(rest, "")
    except (KeyError, ValueError, OverflowError):
        return None


def _product(tokens: Iterator[str], end: str) -> Measure:
    """Read factors up to the token `end`; raises KeyError or ValueError if they are no unit."""
    total, sign = ONE, 1.0
    while True:
        token = next(tokens)
        if token == "(":
            factor = _product(tokens, ")")
        elif token == "1":
            factor = ONE
        else:
            factor = _NAMES[token or "?"]
        token = next(tokens)
        power = 1.0
        if token in ("^", "**"):
            power, token = float(next(tokens)), next(tokens)
        total = total.times(factor, sign * power)
        if token == end:
            return total
        if token not in ("*", "/"):
            raise ValueError(token)
        sign = 1.0 if token == "*" else -1.0


@dataclass(frozen=True)
class DisplayUnit:
    """Display of an SI quantity: shown number = scale * SI number, its unit, decimals."""

    scale: float
    text: str
    decimals: int = 3


_MPA: Final = DisplayUnit(1e-6, "MPa", 2)
_MM: Final = DisplayUnit(1e3, "mm", 1)
READINGS: Final = {  # of a channel, on the operator's screen
    "Pa": _MPA,
    "m": _MM,
    "degC": DisplayUnit(1.0, "°C", 1),
    "rad": DisplayUnit(180.0 / math.pi, "°", 1),
}
LIMITS: Final = {
    "Pa": _MPA,
    "Pa/s": DisplayUnit(1e-9, "GPa/s"),
    "m": _MM,
    "m^3/s": DisplayUnit(6e4, "L/min"),
}
RESULTS: Final = {  # parameters and the errors of equations
    "Pa": _MPA,
    "m": _MM,
    "m^3/s": DisplayUnit(1e6, "mL/s"),
    "m^3/(s*V*Pa^0.5)": DisplayUnit(1e7, "10⁻⁷ m³/(s·V·√Pa)"),
}
RESIDUALS: Final = {
    "Pa": DisplayUnit(1e-3, "kPa"),
    "m": _MM,
    "rad": DisplayUnit(1e3, "mrad"),
}
AXES: Final = {  # variables that a residual is plotted against
    **READINGS,
    **LIMITS,
    "m/s": DisplayUnit(1e3, "mm/s"),
    "rad/s": DisplayUnit(180.0 / math.pi, "°/s"),
}


def display_unit(si: str, table: Mapping[str, DisplayUnit]) -> DisplayUnit:
    """Return the display unit of an SI unit; SI itself if the table has none."""
    return table.get(si) or DisplayUnit(1.0, si)


def clock(seconds: int) -> str:
    """Return a time as a clock shows it: 0:07, 12:30 or 3:05:00."""
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def plain(value: float, digits: int) -> str:
    """Return a number with `digits` significant digits, without exponent below 1e5."""
    text = f"{value:.{digits}g}"
    return f"{Decimal(text):f}" if "e+" in text and abs(value) < _PLAIN_BELOW else text


def with_interval(value: float, half: float, unit: str = "") -> str:
    """Return ``value ± half unit``: half an interval with two digits, the value to its decimals.

    Without exponent where the larger of both is from 1e-3 to 1e5, else both with the same one. An
    unknown half interval (NaN or 0) is left out.
    """
    if not math.isfinite(value) or not math.isfinite(half) or half <= 0.0:
        text = plain(value, 4) + (" ± ∞" if half == math.inf else "")
        return f"{text} {unit}".strip()
    largest = max(abs(value), half)
    inside = _PLAIN_FROM <= largest < _PLAIN_BELOW
    exponent = 0 if inside else math.floor(math.log10(largest))
    power = f"e{exponent}" if exponent else ""
    mantissa = float(f"{half:.1e}") / 10.0**exponent
    places = 1 - math.floor(math.log10(mantissa) + 1e-9)
    numbers = [
        f"{round(x / 10.0**exponent, places) + 0.0:.{max(places, 0)}f}" for x in (value, half)
    ]
    shown, width = (text if float(text) == 0.0 else f"{text}{power}" for text in numbers)
    return f"{shown} ± {width} {unit}".strip()


def typeset(unit: str) -> str:
    """Return a unit as pint writes it with raised powers, dots and roots: N·m, m²."""
    for plain, set_ in (("*", "·"), ("^2", "²"), ("^3", "³"), ("Pa^0.5", "√Pa")):
        unit = unit.replace(plain, set_)
    return unit
