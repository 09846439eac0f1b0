"""What the other methods have to say beyond a list of parameters, as text for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.identify.result import Identification
from rig.cli.output import table


def method_text(result: Identification) -> str:
    """Return the method's own figures as tables, '' where it has none."""
    parts = []
    if "sequential" in result.extra:
        parts.append(_sequential(result.extra["sequential"]))
    if "search" in result.extra:
        parts.append(_search(result.extra["search"]))
    return "".join(f"\n\n{part}" for part in parts)


def _number(entry: Mapping[str, Any] | None) -> str:
    return "—" if entry is None or entry["value"] is None else f"{entry['value']:.5g}"


def _sequential(data: Mapping[str, Any]) -> str:
    """Return every step's own value of every parameter beside E1 and E2, in SI."""
    steps = data["steps"]
    rows = []
    for name, found in data["per_step"].items():
        own = {e["step"]: e for e in found}
        apart = data["disagreement"].get(name)
        rows.append(
            [
                name,
                *(_number(own.get(step)) for step in steps),
                _number(data["E1"][name]),
                _number(data["E2"][name]),
                "" if apart is None else f"{apart:.1f}",
            ]
        )
    header = ["parameter [SI]", *steps, "E1: the first", "E2: average", "apart [95 % intervals]"]
    return "every step by itself\n" + table(header, rows)


def _search(data: Mapping[str, Any]) -> str:
    """Return what became of the candidates."""
    rows = [
        ["candidates", str(data["evaluations"])],
        *([f"lost: {fate}", str(count)] for fate, count in data["lost"].items()),
        [f"lost of the first {data['generation_sizes'][0]}", str(data["lost_first_generation"])],
        ["best error of the first generation", _error(data["error_first_generation"])],
        ["best error", _error(data["error"])],
        ["seconds", f"{data['seconds']:.1f}"],
    ]
    return table([f"search on {data['record']}", ""], rows)


def _error(value: float | None) -> str:
    return "none lived" if value is None else f"{value:.4g}"
