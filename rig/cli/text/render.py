"""Results as text for a terminal: SI values in the units people use, three significant digits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from analysis.identify.result import Identification
from analysis.report.format import MINUS, column_percent
from analysis.simulation.model import Estimate
from analysis.simulation.validate import RecordValidation
from rig.cli.text.output import condition_text, table
from rig.model.units import RESIDUALS, RESULTS, DisplayUnit, typeset

if TYPE_CHECKING:
    from analysis.identify.physical import Physical


def _display_unit(estimate: Estimate) -> tuple[float, str]:
    unit = DisplayUnit(1.0, estimate.unit)
    if estimate.unit == "Pa":
        unit = RESULTS[estimate.unit]
    return unit.scale, typeset(unit.text)


def _share(percent: float) -> str:
    text = column_percent(percent).replace(MINUS, "-")  # three digits, as in all tables
    return f"{text} %" if math.isfinite(percent) else "—"


def _percent(value: float) -> str:
    return f"{value:.1f} %" if math.isfinite(value) else "—"


def parameter_table(
    estimates: Mapping[str, Estimate], truth: Mapping[str, float] | None = None
) -> str:
    """Return the parameters with their 95 % half-widths and, on a simulated bench, the truth."""
    header = ["parameter", "value", "± 95 %", "unit"]
    rows = []
    for name, estimate in estimates.items():
        scale, unit = _display_unit(estimate)
        if not estimate.identified:
            row = [name, "—", "—", unit]
        else:
            low, high = estimate.ci95
            half = 50.0 * (high - low) / abs(estimate.value)
            row = [name, f"{scale * estimate.value:#.4g}", _share(half), unit]
        if truth is not None:
            true_value = truth.get(name, math.nan)
            row += [
                f"{scale * true_value:#.4g}" if math.isfinite(true_value) else "—",
                _share(100.0 * (estimate.value / true_value - 1.0)) if true_value else "—",
            ]
        rows.append(row)
    return table(header + ([] if truth is None else ["truth", "error"]), rows)


def identification_text(result: Identification, truth: Mapping[str, float] | None = None) -> str:
    """Return parameters, conditioning and every check in words."""
    lines = [parameter_table(result.estimates, truth), ""]
    for family, solution in result.solutions.items():
        if not result.rows[family]:
            continue  # a search solves no regression
        condition = condition_text(solution.condition_number)
        lines.append(f"{family}: {result.rows[family]} rows, condition number {condition}")
    lines.append(f"masked rows: {result.masked_rows}; solved in {result.solve_seconds:.3f} s")
    if (estimator := result.model.provenance.get("estimator")) is not None:
        lines.append(f"estimator: {estimator}")
    lines += [
        f"{'ok    ' if check.ok else 'NOT OK'} {check.name}: {check.detail}"
        for check in result.checks
    ]
    lines += [f"note: {n}: {e.note}" for n, e in result.estimates.items() if e.note]
    return "\n".join(lines)


def shapes_text(shapes: Mapping[str, Estimate]) -> str:
    """Return the effects' shapes, one per line, those found with 95 % half-widths; '' if none."""
    lines = []
    for name, shape in shapes.items():
        half = f" ± {shape.half:.2g}" if math.isfinite(shape.half) else ""
        lines.append(f"\nshape: {name} = {shape.value:.4g}{half} {shape.unit}".rstrip())
    return "".join(lines)


def physical_text(physical: Physical) -> str:
    """Return every parameter, unconstrained and at each level, and the level of the result."""
    header = ["parameter [SI]", "free", *(f"{level.name}" for level in physical.levels)]
    rows = []
    for name, free in physical.free.items():
        cells = [name, f"{free.value:.5g}"]
        for level in physical.levels:
            value = level.estimates[name].value
            cells.append(f"{value:.5g} ({100 * (value / free.value - 1):+.2f} %)")
        rows.append(cells)
    level = physical.levels[physical.returned]
    rejected = physical.levels[physical.returned + 1 :]
    rejection = f"; '{rejected[0].name}' is rejected by the data" if rejected else ""
    return f"{table(header, rows)}\nresult: '{level.name}'{rejection}"


def validation_text(results: Sequence[RecordValidation]) -> str:
    """Return FIT of the free run and RMSE of restarted windows, one row per record and channel."""
    rows = []
    for result in results:
        for name, fit in result.fit.items():
            unit = RESIDUALS[result.units[name]]
            rows.append(
                [
                    f"{result.record} {name}",
                    _percent(fit),
                    f"{unit.scale * result.rmse[name]:.3g}",
                    f"{unit.scale * result.window_rmse[name]:.3g}",
                    unit.text,
                ]
            )
    lines = [table(["record and channel", "FIT", "RMSE", "0.25 s RMSE", "unit"], rows)]
    lines += [f"{r.record}: the model failed: {r.failure}" for r in results if r.failure]
    lines += [
        f"{r.record}: {r.outside} samples with a chamber pressure outside 0 .. supply"
        for r in results
        if r.outside
    ]
    return "\n".join(lines)


def method_text(result: Identification) -> str:
    """Return the figures specific to the method as tables, '' if there are none."""
    parts = []
    if "sequential" in result.extra:
        parts.append(_sequential(result.extra["sequential"]))
    if "search" in result.extra:
        parts.append(_search(result.extra["search"]))
    return "".join(f"\n\n{part}" for part in parts)


def _number(entry: Mapping[str, Any] | None) -> str:
    return "—" if entry is None or entry["value"] is None else f"{entry['value']:.5g}"


def _sequential(data: Mapping[str, Any]) -> str:
    """Return each parameter's estimate from every single step and from E1 and E2, in SI."""
    steps = data["steps"]
    rows = []
    for name, estimates in data["per_step"].items():
        by_step = {e["step"]: e for e in estimates}
        disagreement = data["disagreement"].get(name)
        rows.append(
            [
                name,
                *(_number(by_step.get(step)) for step in steps),
                _number(data["E1"][name]),
                _number(data["E2"][name]),
                "" if disagreement is None else f"{disagreement:.1f}",
            ]
        )
    header = ["parameter [SI]", *steps, "E1: the first", "E2: average", "apart [95 % intervals]"]
    return "every step by itself\n" + table(header, rows)


def _search(data: Mapping[str, Any]) -> str:
    """Return the search's counts of candidates and its errors."""
    rows = [
        ["candidates", str(data["evaluations"])],
        *([f"lost: {cause}", str(count)] for cause, count in data["lost"].items()),
        [f"lost of the first {data['generation_sizes'][0]}", str(data["lost_first_generation"])],
        ["best error of the first generation", _error(data["error_first_generation"])],
        ["best error", _error(data["error"])],
        ["seconds", f"{data['seconds']:.1f}"],
    ]
    return table([f"search on {data['record']}", ""], rows)


def _error(value: float | None) -> str:
    return "none lived" if value is None else f"{value:.4g}"
