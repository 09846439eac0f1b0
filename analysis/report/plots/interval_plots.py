"""Parameters as dots with whiskers: against a reference, and the width of the interval."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from analysis.report.plots.style import BLUE, GREY, INK, MODEL, PALE, figure, style, svg
from analysis.report.settings import REPORT
from analysis.simulation.model import Estimate

ROW = 0.2  # [in] per parameter


def against_reference(
    estimates: Mapping[str, Estimate], reference: Mapping[str, float], kind: str
) -> Markup:
    """Draw (value - reference)/reference [%] with its 95 % interval; `kind` names the reference."""
    names = list(estimates)
    rows = {
        name: [100.0 * (v / reference[name] - 1.0) for v in (e.value, *e.ci95)]
        for name, e in estimates.items()
        if e.identified and reference.get(name)
    }
    with style():
        canvas, axes = _canvas(len(names))
        limit = _limit([max(abs(v) for v in row if np.isfinite(v)) for row in rows.values()])
        axes.axvline(0.0, color=INK, linewidth=0.8)
        for y, name in enumerate(names):
            if name in rows:
                _whisker(axes, y, rows[name], limit)
            else:
                why = "not identifiable" if not estimates[name].identified else f"no {kind} value"
                axes.text(0.0, y, f" {why}", color=GREY, fontsize=7, va="center")
        _rows(axes, names)
        axes.set_xlim(-limit, limit)
        axes.set_xlabel(f"deviation from {kind} [%]")
        axes.set_title("estimate and 95 % interval")
        return svg(canvas, "par-ref", f"Deviation of every parameter from its {kind} value")


def _canvas(parameters: int) -> tuple[Figure, Any]:
    """Return a figure with a row for each parameter, and its axes."""
    height = 0.75 + ROW * parameters
    canvas = figure(height)
    return canvas, canvas.add_axes((0.13, 0.42 / height, 0.84, 1 - 0.62 / height))


def _limit(extents: list[float]) -> float:
    if not extents:
        return 1.0
    quartile = float(np.quantile(extents, 0.75))
    return float(1.12 * min(max(extents), REPORT.interval_span * quartile) or 1e-3)


def _whisker(axes: Any, y: int, row: list[float], limit: float) -> None:
    value, low, high = row
    ends = np.clip([low, high], -limit, limit)
    axes.plot(ends, [y, y], color=BLUE, linewidth=1.6, solid_capstyle="butt")
    for end, raw in zip(ends, (low, high), strict=True):
        if abs(raw) <= limit:
            axes.plot([end, end], [y - 0.18, y + 0.18], color=BLUE, linewidth=1.0)
    if abs(value) <= limit:
        axes.plot([value], [y], "o", color=BLUE, markersize=3.6)
    else:
        side = np.sign(value)
        axes.plot(
            [side * limit * 0.985], [y], ">" if side > 0 else "<", color=MODEL, markersize=4.5
        )
        axes.text(
            side * limit * 0.95, y, f"{value:+.3g} %", color=MODEL, fontsize=7, va="center",
            ha="right" if side > 0 else "left",
        )  # fmt: skip


def _rows(axes: Any, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def interval_widths(estimates: Mapping[str, Estimate]) -> Markup:
    """Draw half the 95 % interval relative to the value [%] on a logarithmic axis."""
    names = list(estimates)
    widths = [relative_half_width(e) for e in estimates.values()]
    shown = [w for w in widths if np.isfinite(w) and w > 0]
    with style():
        canvas, axes = _canvas(len(names))
        low = min(shown, default=0.1) / 2
        axes.set_xscale("log")
        for y, width in enumerate(widths):
            if np.isfinite(width) and width > 0:
                axes.plot([low, width], [y, y], color=PALE, linewidth=3.0, solid_capstyle="butt")
                axes.plot([width], [y], "o", color=BLUE, markersize=3.6)
                axes.text(width * 1.12, y, f"{width:.2g} %", fontsize=7, va="center")
            else:
                axes.text(low, y, " no interval", color=GREY, fontsize=7, va="center")
        _rows(axes, names)
        axes.set_xlim(low, max(shown, default=1.0) * 2.5)
        axes.set_xlabel("half of the 95 % interval, relative to the value [%]")
        axes.set_title("relative interval")
        axes.xaxis.set_major_formatter(lambda v, _: f"{v:g}")
        return svg(canvas, "par-ci", "Relative half width of every parameter's 95 % interval")


def relative_half_width(estimate: Estimate) -> float:
    """Return half the 95 % interval over the value [%]; NaN or inf where there is none."""
    low, high = estimate.ci95
    return float(50.0 * (high - low) / abs(estimate.value)) if estimate.value else float("nan")
