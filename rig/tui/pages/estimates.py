"""Live identification: parameters with intervals and the residual, while the experiment runs."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from rig.model.units import plain, with_interval
from rig.tui.drawing.plot import PlotTrace, draw, time_axis
from rig.tui.drawing.rows import Row, block, box, fit, grid, marked, row, wrapped
from rig.tui.drawing.styles import DIM, STRONG, WARN_TEXT
from rig.tui.following.link import TrackedPoint
from rig.tui.look import PlotView
from rig.tui.pages.parts import WIDTH, freshness_label
from rig.tui.units import clock_text, shown
from rig.tui.words import Freshness

EQUATIONS: Final = {"fluid": ("flow", "m³/s"), "mechanical": ("torque", "N·m")}
LEAST_PLOT: Final = 5  # rows of a box: its frame, its line, a row of curve, the axis


@dataclass(frozen=True)
class OnlineSettings:
    """Limits of the warnings about an experiment; shares are of 1.

    All are judged by eye on simulated benches, where a good experiment has a residual of 0.003 of
    the flow.
    """

    updates: int = 8  # changes of an interval before it is judged: some 16 s
    wide: float = 0.02  # half an interval over its value, below which it need not shrink
    shrunk: float = 0.95  # of the interval at half the updates; 0.71 where each brings as much
    few: int = 5  # newest residuals whose median is judged
    grown: float = 2.0  # times the least median before
    small: float = 0.02  # of the equations' size, below which a residual is no reason for a warning
    large: float = 0.5  # of the equations' size: the model explains less than half of it


ONLINE: Final = OnlineSettings()


def half_widths(series: Sequence[TrackedPoint], name: str) -> list[tuple[float, float]]:
    """Return (time [s], half the 95 % interval over the value) where either has changed.

    A parameter that the present step does not excite does not change.
    """
    widths: list[tuple[float, float]] = []
    previous: Sequence[float | None] = ()
    for point in series:
        newest = point.values.get(name, ())
        if newest == previous or len(newest) != 3:
            continue
        previous = newest
        value, low, high = newest
        if value and low is not None and high is not None:
            widths.append((point.time, abs(0.5 * (high - low) / value)))
    return widths


def shares(series: Sequence[TrackedPoint], family: str) -> list[tuple[float, float]]:
    """Return (time [s], residual over the size of the equations) of a family."""
    parts = []
    for point in series:
        rms, size = point.residuals.get(family, (0.0, 0.0))
        if size > 0.0:
            parts.append((point.time, rms / size))
    return parts


def warnings_of(series: Sequence[TrackedPoint]) -> list[str]:
    """Return warnings about the experiment in sentences, the residual first."""
    warnings = []
    for family in families(series):
        warnings += _about_residual(EQUATIONS.get(family, (family, ""))[0], shares(series, family))
    for name in series[-1].values if series else ():
        widths = half_widths(series, name)
        if len(widths) < ONLINE.updates:
            continue
        when, earlier = widths[(len(widths) - 1) // 2]
        now = widths[-1][1]
        if now > max(ONLINE.wide, ONLINE.shrunk * earlier):
            warnings.append(
                f"{name}: its interval does not shrink, ±{earlier:.0%} at {clock_text(when)} and "
                f"±{now:.0%} now: more amplitude, other lines, or air and play in the way?"
            )
    return warnings


def _about_residual(name: str, residuals: Sequence[tuple[float, float]]) -> list[str]:
    few = ONLINE.few
    if len(residuals) < few:
        return []
    medians = [
        statistics.median(share for _, share in residuals[k : k + few])
        for k in range(len(residuals) - few + 1)
    ]
    now = medians[-1]
    least = min(range(len(medians)), key=lambda k: medians[k])
    if now > ONLINE.large:
        return [
            f"{name}: {now:.0%} remains as residual: the model explains less than half. "
            "Check signs, units and sensors before continuing."
        ]
    if now > max(ONLINE.small, ONLINE.grown * medians[least]):
        when = clock_text(residuals[least + few - 1][0])
        return [
            f"{name}: the residual grows, {medians[least]:.1%} at {when} and {now:.1%} now: has "
            "the bench changed (oil, air, a lock that gives)?"
        ]
    return []


def families(series: Sequence[TrackedPoint]) -> list[str]:
    """Return the families of equations that have a residual."""
    return list(dict.fromkeys(family for point in series for family in point.residuals))


def estimates_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return residuals and parameters with their 95 % intervals over the run's time.

    Warnings are above them, parameters still unknown below.
    """
    series = view.newest.estimates
    newest = series[-1].values if series else {}
    names = [name for name, estimate in newest.items() if estimate[0] is not None]
    if not names:
        text = "Nothing is estimated yet: `bramah run --track` follows b and the flow gains."
        return block(wrapped(f" {text}", width, DIM), width, height)
    head: list[Row] = []
    for text in warnings_of(series):
        lines = marked((" ▲ ", WARN_TEXT), text, width, WARN_TEXT)
        head += [fit(line, width) for line in lines]
    unknown = ", ".join(name for name in newest if name not in names)
    foot = [fit(row((f" not known yet: {unknown}", DIM)), width)] if unknown else []
    boxes = {family: partial(_residual, view, family) for family in families(series)}
    boxes |= {name: partial(_estimate, view, name) for name in names}
    room = height - len(head) - len(foot)
    across = max(min(width // WIDTH, len(boxes)), 1)
    rows, hidden = grid(list(boxes.values()), across, LEAST_PLOT, width, room)
    if hidden > 0:
        text = ", ".join(list(boxes)[-hidden:])
        foot = [fit(row((f" a larger terminal also shows {text}", DIM)), width)]
    return block([*head, *rows, *foot], width, height)


def _residual(view: PlotView, family: str, width: int, height: int) -> list[Row]:
    """Return the residual of new rows by the estimates before them, as a share of the rows."""
    name, unit = EQUATIONS.get(family, (family, ""))
    residuals = shares(view.newest.estimates, family)
    rms = view.newest.estimates[-1].residuals.get(family, (float("nan"),))[0]
    time, share = np.array(residuals).reshape(-1, 2).T
    warned = bool(_about_residual(name, residuals))
    line = row(
        (f"{1e2 * share[-1]:.2g} %" if len(share) else "–", STRONG),
        (f", rms {rms:.2g} {unit}  ", DIM),
        ("▲", WARN_TEXT) if warned else ("", ""),
    )
    return _box(
        view, f"residual of {name}, held out", line, time, 1e2 * share, 1e2 * share, width, height
    )


def _estimate(view: PlotView, name: str, width: int, height: int) -> list[Row]:
    nan = float("nan")
    points = [
        (point.time, [nan if v is None else float(v) for v in point.values[name]])
        for point in view.newest.estimates
        if name in point.values and point.values[name][0] is not None
    ]
    time = np.array([at for at, _ in points])
    table = np.array([estimate for _, estimate in points])
    low = np.where(np.isnan(table[:, 1]), table[:, 0], table[:, 1])
    high = np.where(np.isnan(table[:, 2]), table[:, 0], table[:, 2])
    value = table[-1, 0]
    half = 0.5 * (table[-1, 2] - table[-1, 1])
    share = abs(half / value) if value else nan
    wide = ("▲ wide ", WARN_TEXT) if not share < 0.5 else ("", "")
    text, _, width_text = with_interval(float(value), float(half)).partition(" ± ")
    interval = f" ± {width_text or '?'} ({plain(1e2 * share, 2)} %, 95 %)  "
    line = row((text, STRONG), (interval, DIM), wide)
    power = 3 * math.floor(math.log10(abs(value)) / 3) if value else 0  # the axis has few digits
    title = f"{name}  axis in 1e{power}" if power else name
    scale = 10.0**-power
    return _box(view, title, line, time, scale * low, scale * high, width, height)


def _box(
    view: PlotView,
    name: str,
    line: Row,
    time: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    width: int,
    height: int,
) -> list[Row]:
    """Return a line and the band from `low` to `high`, each (n,), over time in a frame."""
    inner = width - 4
    start, stop = (float(time[0]), float(time[-1])) if len(time) else (0.0, 0.0)
    stop = max(stop, start + 1.0)
    live = view.fresh is Freshness.LIVE
    trace = PlotTrace(time, low, high, start, stop, (None, None), shown(""), live, True)
    plot = draw(trace, inner, height - 4)
    rows = [fit(line, inner), *plot, time_axis(start, stop, inner)]
    return box(name, rows, width, height, DIM, freshness_label(view))
