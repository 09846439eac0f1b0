"""Figures of records: excitation (time and lines), residual of the regression, free run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from analysis.report.format import display_unit, fit, significant
from analysis.report.plots.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    MODEL,
    ORANGE,
    SKY,
    Array,
    figure,
    gapped,
    note,
    plain_log,
    style,
    svg,
    thin,
)
from analysis.report.residuals import Residual
from analysis.report.settings import REPORT
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from rig.model.records import Record, bridged
from rig.model.rig import Rig


@dataclass(frozen=True)
class LineSpectrum:
    """Amplitudes [V] at multiples of 1/period: frequency [Hz], amplitude, whether excited."""

    frequency: Array
    amplitude: Array
    excited: NDArray[np.bool_]
    even: NDArray[np.bool_]


def line_spectrum(record: Record, x: Array) -> LineSpectrum | None:
    """Return a channel's amplitude [V peak] at the period's multiples; None if not periodic.

    Over whole periods only, so that no line leaks into its neighbours.
    """
    periods = len(x) // record.period if record.period else 0
    if not periods or not record.lines:
        return None
    periodic = x[: periods * record.period]
    spectrum = 2.0 * np.abs(np.fft.rfft(periodic)) / len(periodic)
    shown = max(round(1.35 * max(record.lines)), REPORT.fewest_lines)
    k = np.arange(1, min(shown, record.period // 2) + 1)
    return LineSpectrum(
        k * record.sample_rate / record.period, spectrum[k * periods],
        np.isin(k, record.lines), k % 2 == 0,
    )  # fmt: skip


def excitation(rig: Rig, record: Record, joint: int, key: str) -> Markup:
    """Draw command and spool of one joint over time, and their lines."""
    gain = rig.joints[joint - 1].valve.spool_gain
    spool = bridged(np.asarray(record.channels[ch.channel(ch.SPOOL, joint)]))
    command = record.channels.get(ch.channel(ch.COMMAND, joint))
    shown = slice(0, int(min(record.samples, REPORT.record_seconds * record.sample_rate)))
    with style():
        canvas = figure(3.7)
        top = canvas.add_axes((0.15, 0.60, 0.82, 0.33))
        low = canvas.add_axes((0.15, 0.115, 0.82, 0.33))
        if command is not None:
            top.plot(
                *thin(record.time[shown], np.asarray(command)[shown]), color=SKY, linewidth=2.2
            )
        top.plot(*thin(record.time[shown], spool[shown] / gain), color=INK, linewidth=0.7)
        top.margins(x=0, y=0.22)
        top.set_ylabel("V of command")
        top.set_xlabel("time [s]", labelpad=1)
        top.set_title("command and spool")
        note(top, 0.995, 0.99, f"spool, divided by its gain of {gain:g}", INK)
        if command is not None:
            note(top, 0.005, 0.99, "command", BLUE, ha="left")
        _spectrum(low, record, spool)
        return svg(canvas, key, f"Excitation of joint {joint} in time and frequency")


def electric_excitation(rig: Rig, record: Record, joint: int, key: str) -> Markup:
    """Draw drive and position of one electric joint in time."""
    shown = slice(0, int(min(record.samples, REPORT.electric_seconds * record.sample_rate)))
    with style():
        canvas = figure(3.7)
        for row, kind in enumerate((ch.DRIVE, ch.POSITION)):
            axes = canvas.add_axes((0.15, 0.60 - 0.485 * row, 0.82, 0.33))
            name = ch.channel(kind, joint)
            x = bridged(np.asarray(record.channels[name]))
            axes.plot(*thin(record.time[shown], x[shown]), color=INK, linewidth=0.7)
            axes.margins(x=0, y=0.12)
            axes.set_ylabel(f"{kind} [{rig.unit_of(name)}]")
            axes.set_xlabel("time [s]", labelpad=1)
        return svg(canvas, key, f"Drive and position of joint {joint} in time")


def _spectrum(axes: Any, record: Record, spool: Array) -> None:
    axes.set_yscale("log")
    plain_log(axes.yaxis)
    axes.set_xlabel("frequency [Hz]", labelpad=1)
    axes.set_ylabel("spool [mV]")
    axes.set_title("amplitude of each line")
    lines = line_spectrum(record, spool)
    if lines is None:
        _unknown_lines(axes, record, spool)
        return
    # An amplitude of exactly zero would have no place on the logarithmic axis.
    amplitude = 1e3 * np.maximum(lines.amplitude, 1e-7 * lines.amplitude.max() + 1e-12)
    floor = amplitude.min() / 3
    kinds = (
        ("excited", lines.excited, BLUE, "o", 3.2),
        ("empty, odd", ~lines.excited & ~lines.even, ORANGE, "^", 3.0),
        ("empty, even", ~lines.excited & lines.even, GREEN, "s", 2.2),
    )
    x = 0.005
    for name, chosen, colour, marker, size in kinds:
        if not chosen.any():
            continue
        axes.vlines(lines.frequency[chosen], floor, amplitude[chosen], color=colour, linewidth=0.6,
                    alpha=0.5)  # fmt: skip
        axes.plot(lines.frequency[chosen], amplitude[chosen], marker, color=colour, markersize=size)
        note(axes, x, 1.0, {"o": "●", "^": "▲", "s": "■"}[marker] + " " + name, colour, ha="left")
        x += 0.06 + 0.023 * len(name)
    axes.set_ylim(floor, amplitude.max() * 6)
    axes.set_xlim(0, lines.frequency[-1] * 1.02)


def _unknown_lines(axes: Any, record: Record, spool: Array) -> None:
    window = np.hanning(len(spool))
    spectrum = 2e3 * np.abs(np.fft.rfft((spool - spool.mean()) * window)) / window.sum()
    frequency: Array = np.fft.rfftfreq(len(spool), 1.0 / record.sample_rate).astype(np.float64)
    inside = (frequency > 0) & (frequency <= min(50.0, 0.4 * record.sample_rate))
    amplitude: Array = np.maximum(spectrum[inside], 1e-9).astype(np.float64)
    axes.plot(*thin(frequency[inside], amplitude), color=BLUE, linewidth=0.8)
    axes.margins(x=0)
    note(axes, 0.995, 0.99, "excited lines not stated in the record", GREY)


def residual(shown: Residual, key: str) -> Markup:
    """Draw one equation's residual in time, and its density against the scatter of repeats."""
    unit = display_unit(shown.unit)
    with style():
        canvas = figure(3.3)
        top = canvas.add_axes((0.15, 0.60, 0.82, 0.32))
        low = canvas.add_axes((0.15, 0.125, 0.82, 0.31))
        t, mean = gapped(shown.time, unit.scale * shown.mean)
        if shown.repeats > 1:
            _, band = gapped(shown.time, unit.scale * shown.scatter_band)
            top.fill_between(t, mean - band, mean + band, color=SKY, alpha=0.45, linewidth=0)
        top.plot(t, mean, color=BLUE, linewidth=0.8)
        top.axhline(0, color=INK, linewidth=0.5)
        top.margins(x=0, y=0.25)
        top.yaxis.set_major_locator(MaxNLocator(4))
        top.set_ylabel(unit.text)
        top.set_xlabel("time [s]", labelpad=1)
        top.set_title(
            f"residual; measured side {significant(unit.scale * shown.rms_side)} {unit.text} RMS"
        )
        caption = "mean of repeats, ±1 scatter" if shown.repeats > 1 else "the only repeat"
        note(top, 0.995, 0.99, caption, BLUE)
        _densities(low, shown, unit.scale, unit.text)
        return svg(
            canvas, key, f"Residual of one equation of joint {shown.joint}, time and spectrum"
        )


def _densities(axes: Any, residual: Residual, scale: float, unit: str) -> None:
    axes.set_yscale("log")
    plain_log(axes.yaxis)
    axes.plot(residual.frequency, scale * residual.spectrum, color=BLUE, linewidth=1.0)
    above = {"va": "bottom", "ha": "left"}
    note(
        axes,
        0.0,
        1.02,
        "mean of repeats" if residual.repeats > 1 else "the only repeat",
        BLUE,
        **above,
    )
    if residual.repeats > 1:
        axes.plot(residual.frequency, scale * residual.spectrum_scatter, color=GREY, linewidth=1.0)
        floor = scale * residual.spectrum_scatter / np.sqrt(residual.repeats)
        axes.plot(residual.frequency, floor, color=MODEL, linewidth=0.9, linestyle=(0, (4, 2)))
        note(axes, 0.26, 1.02, "scatter of one repeat", "#6b7280", **above)
        note(axes, 0.59, 1.02, "scatter left in the mean", "#c2410c", **above)
    axes.margins(x=0)
    # The row filter's stop band would take up most of the axis.
    lowest = scale * float(residual.spectrum.max()) / REPORT.spectrum_span
    axes.set_ylim(bottom=max(axes.get_ylim()[0], lowest))
    axes.set_xlabel("frequency [Hz]", labelpad=1)
    axes.set_ylabel(f"{unit}/√Hz")


def shown_part(result: RecordValidation) -> slice:
    """Return the samples that are drawn: the last four seconds, or the whole of a short record."""
    n = len(result.time)
    rate = result.simulation.rate
    return slice(max(0, n - round(REPORT.free_run_seconds * rate)), n)


def comparison(
    rig: Rig, result: RecordValidation, record: Record | None, joint: int, key: str
) -> Markup:
    """Draw a free run as the paper's Figs. 6 to 10 do, FIT in the panels' titles.

    The spool drives the model; below it are the piston over the stroke L and the pressures over the
    supply p_s. Black is measured, the model is the palette's red.
    """
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
