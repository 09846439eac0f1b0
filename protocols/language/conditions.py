"""Conditions on measured or estimated values: parsed once, evaluated repeatedly, without code.

    condition   = comparison, {("and" | "or"), comparison}    "and" binds before "or"
    comparison  = name, (">" | ">=" | "<" | "<="), number, [unit]
    name        = channel | "elapsed" | parameter | parameter, ".rsd"

`oil_temperature > 40 degC`, `b.rsd < 0.5 %`, `supply_pressure < 6.5 MPa or elapsed > 2 min`.
A channel counts as its mean over the last 0.1 s; `elapsed` is the time in the step; a parameter is
the on-line estimate and its `.rsd` the standard deviation over the value. An unknown value fulfils
no comparison.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rig.model import channels as ch
from rig.model.parameters import parameter_names, parameter_unit
from rig.model.quantity import UnitError, parse_quantity
from rig.model.rig import Rig
from rig.model.units import READINGS, display_unit

ELAPSED = "elapsed"
RSD = ".rsd"
LONGEST = 500  # characters

_COMPARE: Mapping[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}
_TERM = re.compile(r"^\s*(?P<name>[A-Za-z][\w.]*)\s*(?P<op>>=|<=|>|<)\s*(?P<value>[^<>=]+?)\s*$")


@dataclass(frozen=True)
class Comparison:
    """One comparison, its number in SI."""

    name: str
    sign: str
    value: float

    def holds(self, values: Mapping[str, float]) -> bool:
        """Return whether it holds; False for a missing or NaN value."""
        value = values.get(self.name, math.nan)
        return math.isfinite(value) and _COMPARE[self.sign](value, self.value)


@dataclass(frozen=True)
class Condition:
    """Alternatives, each a group of comparisons that must hold together; `text` as read."""

    text: str
    alternatives: tuple[tuple[Comparison, ...], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the values it needs."""
        return tuple(dict.fromkeys(c.name for group in self.alternatives for c in group))

    @property
    def estimates(self) -> tuple[str, ...]:
        """The parameters whose on-line estimates it needs."""
        names = (n for n in self.names if n != ELAPSED and not _is_channel(n))
        return tuple(dict.fromkeys(name.removesuffix(RSD) for name in names))

    def holds(self, values: Mapping[str, float]) -> bool:
        """Return whether it holds for `values` in SI by name."""
        return any(all(c.holds(values) for c in group) for group in self.alternatives)

    def readings(self, values: Mapping[str, float]) -> str:
        """Return the values it compares, in display units: 'oil_temperature 38.2 °C'."""
        names = [name for name in self.names if name != ELAPSED]
        readings = [_reading(name, values.get(name, math.nan)) for name in names]
        return ", ".join(readings) or "it compares the time alone"


def parse_condition(text: str) -> Condition:
    """Parse a condition; raises ValueError naming the wrong part and what was expected."""
    if len(text) > LONGEST:
        raise ValueError(f"a condition of {len(text)} characters; expected at most {LONGEST}")
    groups = re.split(r"\s+or\s+", text.strip())
    return Condition(
        text.strip(),
        tuple(
            tuple(_comparison(term) for term in re.split(r"\s+and\s+", group)) for group in groups
        ),
    )


def require_known(condition: Condition, rig: Rig) -> None:
    """Raise ValueError where the rig has no such channel or its model no such parameter."""
    parameters = () if rig.electric else parameter_names(len(rig.joints))
    for name in condition.names:
        if name == ELAPSED or name in rig.recorded or name.removesuffix(RSD) in parameters:
            continue
        what = "channel" if _is_channel(name) else "parameter"
        known = rig.recorded if _is_channel(name) else parameters
        raise ValueError(
            f"{condition.text!r}: rig {rig.name!r} has no {what} {name.removesuffix(RSD)!r}; "
            f"it has: {' '.join(known)}"
        )


def _comparison(text: str) -> Comparison:
    match = _TERM.match(text)
    if match is None:
        raise ValueError(
            f"{text.strip()!r} is no comparison; expected one like 'oil_temperature > 40 degC'"
        )
    name = match["name"]
    try:
        value = parse_quantity(match["value"], _unit(name))
    except UnitError as error:
        raise ValueError(f"{text.strip()!r}: {error}") from error
    return Comparison(name, match["op"], value)


def _reading(name: str, value: float) -> str:
    if not math.isfinite(value):
        return f"{name} unknown"
    if name.endswith(RSD):
        return f"{name} {100.0 * value:.3g} %"
    shown = display_unit(_unit(name), READINGS)
    return f"{name} {shown.scale * value:.4g} {shown.text}".rstrip()


def _is_channel(name: str) -> bool:
    try:
        ch.kind_of(name)
    except ValueError:
        return False
    return True


def _unit(name: str) -> str:
    if name == ELAPSED:
        return "s"
    if name.endswith(RSD):
        return ""
    if _is_channel(name):
        return ch.unit_of(name)
    if any(name in parameter_names(n) for n in (1, 2, 3, 9)):
        return parameter_unit(name)
    raise ValueError(
        f"{name!r} is neither a channel nor a parameter; expected one like 'oil_temperature', "
        "'cap_pressure_1', 'elapsed', 'b' or 'b.rsd'"
    )
