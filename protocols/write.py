"""A protocol back as a file that `protocols.library.load` reads: units beside every number."""

from __future__ import annotations

from typing import Any, Final

import yaml

from protocols.model import Protocol

_UNITS: Final = {
    "base_frequency": "Hz", "frequency": "Hz", "f_min": "Hz", "f_max": "Hz",
    "amplitude": "V", "amplitudes": "V", "limit": "V", "push": "V",
    "phases": "rad", "position_gain": "V/m",
    "piston": "m", "tolerance": "m", "centre": "m", "drift": "m", "offset": "m",
    "timeout": "s", "duration": "s", "ramp": "s", "settle": "s",
}  # fmt: skip
_DIGITS: Final = {"amplitudes": 5, "phases": 5}  # significant; others are written in full


class _Flow(list[Any]):
    """A list written on one line."""


class _Dumper(yaml.SafeDumper):
    """Its own class, so that the library's is left alone."""


_Dumper.add_representer(
    _Flow, lambda d, x: d.represent_sequence("tag:yaml.org,2002:seq", x, flow_style=True)
)
_Dumper.ignore_aliases = lambda self, data: True  # type: ignore[method-assign]


def _text(key: str, value: float) -> str:
    digits = _DIGITS.get(key)
    return f"{value:.{digits}g} {_UNITS[key]}" if digits else f"{value!r} {_UNITS[key]}"


def _plain(key: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(k, v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        inner = [_plain(key, v) for v in value]
        return inner if any(isinstance(v, dict) for v in inner) else _Flow(inner)
    if key in _UNITS and isinstance(value, int | float):
        return _text(key, float(value))
    return value


def protocol_text(protocol: Protocol, comment: str = "") -> str:
    """Return the file's text; `comment` lines stand above it. What was left at default stays so."""
    data = protocol.model_dump(mode="json", exclude_unset=True)
    body = yaml.dump(
        _plain("", data), Dumper=_Dumper, sort_keys=False, width=100, allow_unicode=True
    )
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    return head + body
