"""Measured against simulated in the manner of the paper's Figs. 6 to 10.

Spool input on top, piston normalised by the stroke L, pressures by the supply p_s; black is
measured, the model is the palette's red.
"""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator

from analysis.report.format import fit
from analysis.report.plots.style import GREY, INK, MODEL, figure, note, style, svg, thin
from analysis.report.settings import REPORT
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig


def shown_part(result: RecordValidation) -> slice:
    """Return the samples that are drawn: the last four seconds, or the whole of a short record."""
    n = len(result.time)
    rate = result.simulation.rate
    return slice(max(0, n - round(REPORT.free_run_seconds * rate)), n)


def comparison(
    rig: Rig, result: RecordValidation, record: Record | None, joint: int, key: str
) -> Markup:
    """Draw spool, piston/L, p_cap/p_s and p_rod/p_s of one joint, FIT in the panels' titles."""
    part = shown_part(result)
    t = result.time[part]
    model = result.simulation.channels()
    real = min(result.simulation.filled, len(result.time))
    panels = (
        (ch.PISTON, "piston / L", 1.0 / rig.joints[joint - 1].cylinder.stroke),
        (ch.CAP, "cap pressure / p_s", 1.0 / rig.supply.pressure),
        (ch.ROD, "rod pressure / p_s", 1.0 / rig.supply.pressure),
    )
    with style():
        canvas = figure(4.7)
        grid = canvas.subplots(
            4, 1, sharex=True,
            gridspec_kw={"left": 0.13, "right": 0.975, "top": 0.955, "bottom": 0.085,
                         "hspace": 0.42, "height_ratios": (0.7, 1, 1, 1)},
        )  # fmt: skip
        name, points = ch.channel(ch.SPOOL, joint), REPORT.free_run_points
        if record is not None and name in record.channels:
            spool = np.asarray(record.channels[name])[part]
            grid[0].plot(*thin(t, spool, points), color=INK, linewidth=0.8)
        grid[0].set_title("spool [V], measured, drives the model")
        for axes, (kind, title, scale) in zip(grid[1:], panels, strict=True):
            name = ch.channel(kind, joint)
            if name not in result.measured:
                note(axes, 0.5, 0.5, "not measured", GREY, ha="center")
                continue
            axes.plot(
                *thin(t, scale * result.measured[name][part], points), color=INK, linewidth=2.2
            )
            end = min(real, part.stop)
            if end > part.start:
                inside = slice(part.start, end)
                axes.plot(*thin(result.time[inside], scale * model[name][inside], points),
                          color=MODEL, linewidth=0.9)  # fmt: skip
            axes.set_title(f"{title} · FIT {fit(result.fit[name])} %")
        note(grid[1], 0.005, 1.0, "measured", INK, ha="left")
        note(grid[1], 0.16, 1.0, "model", MODEL, ha="left")
        for axes in grid:
            axes.margins(x=0, y=0.12)
            axes.yaxis.set_major_locator(MaxNLocator(4))
        grid[1].margins(x=0, y=0.3)
        grid[-1].set_xlabel("time [s]", labelpad=1)
        if result.failure and real < part.stop:
            note(grid[1], 0.995, 1.0, "the simulation failed", MODEL)
        return svg(canvas, key, f"Measured and simulated channels of joint {joint}")
