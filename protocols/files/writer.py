"""Writes a protocol as a file that `protocols.files.library.load` reads back unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from protocols.files.schema import Protocol

# Unit written after each quantity, and its number per SI unit.
_UNITS: Mapping[str, tuple[str, float]] = {
    key: (unit, scale)
    for unit, scale, keys in (
        ("V/m", 1.0, "position_gain"),
        ("V", 1.0, "limit push amplitude amplitudes"),
        ("mm", 1e3, "tolerance piston travel drift offset centre"),
        ("Hz", 1.0, "frequency base_frequency f_min f_max"),
        ("rad", 1.0, "phases"),
        ("s", 1.0, "timeout record wait hold pause rise width rest edge period duration"),
        ("s", 1.0, "ramp settle"),
    )
    for key in keys.split()
}
_DIGITS: Mapping[str, int] = {"amplitudes": 5, "phases": 5}  # significant; others: 12


class _Row(list[Any]):
    """A list of plain values, written on one line."""


class _Dumper(yaml.SafeDumper):
    """A separate dumper, so that the library's is unchanged."""


_Dumper.add_representer(
    _Row, lambda dumper, row: dumper.represent_sequence("tag:yaml.org,2002:seq", row, True)
)


def protocol_text(protocol: Protocol, comment: str = "") -> str:
    """Return the YAML of a protocol with `comment` above it, without default values."""
    data = _quantities(protocol.model_dump(mode="json", exclude_defaults=True))
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    body = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    return "\n".join([*lines, body])


def _quantities(value: Any, key: str = "") -> Any:
    if isinstance(value, dict):
        if key == "parameters":
            return value  # as the person wrote them
        return {name: _quantities(item, name) for name, item in value.items()}
    if isinstance(value, list):
        items = [_quantities(item, key) for item in value]
        return items if any(isinstance(item, dict) for item in items) else _Row(items)
    if key in _UNITS and isinstance(value, int | float):
        unit, scale = _UNITS[key]
        digits = _DIGITS.get(key, 12)
        return f"{float(f'{value * scale:.{digits}g}'):.{digits}g} {unit}"
    return value
