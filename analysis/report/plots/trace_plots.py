"""The trace's figures: residual before and after, against a variable and in time.

All are of held-out records. Grey is before, blue after; the pale band is the noise (± one rms).
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from analysis.effects.base import Effect
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows
from analysis.report import format as fm
from analysis.report.plots.style import (
    BLUE,
    CARD,
    GREY,
    INK,
    MODEL,
    ORANGE,
    PALE,
    Array,
    figure,
    gapped,
    note,
    style,
    svg,
)
from analysis.report.settings import REPORT
from analysis.simulation.model import Model
from analysis.terms.base import family_of, joint_of
from analysis.trace.clues.equation_rows import variables
from analysis.trace.data.conditioned_record import (
    conditioned_records,
    filtered,
    model_rows,
    prepared_signals,
    row_residual,
)
from analysis.trace.data.spectral_lines import CONSTANT, EVEN, EXCITED, ODD, lines_by_kind
from analysis.trace.data.spectral_lines import SpectralLines as Spectrum
from analysis.trace.result import JudgedEffect, Rival, Trace
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.settings import TRACE
from analysis.trace.words import equation_of_largest_reduction
from rig.model import channels as ch
from rig.model.records import Run
from rig.model.rig import Rig
from rig.model.units import AXES, display_unit, typeset

LINE_LENGTH = 125  # [characters] of a line across a page


@dataclass(frozen=True)
class ResidualSeries:
    """Held-out residuals of one equation of one record, SI, at the instants of its rows."""

    conditioned: ConditionedRecord
    rows: Rows
    before: Array
    after: Array


def held_out(rig: Rig, holdout: Sequence[Run], result: Trace) -> dict[str, list[ResidualSeries]]:
    """Return, by equation, every held-out record's residual under both models."""
    out: dict[str, list[ResidualSeries]] = {}
    families = tuple({family_of(e): None for e in result.before})
    for conditioned in conditioned_records(rig, holdout, families=families):
        before = _residuals(rig, conditioned, result.rows_before)
        after = _residuals(rig, conditioned, result.rows_after)
        for name, (rows, r) in before.items():
            later, q = after[name]
            _, i, j = np.intersect1d(rows.time, later.time, return_indices=True)
            part = Rows(name, rows.names, rows.matrix[i], rows.rhs[i], rows.time[i], 0)
            out.setdefault(name, []).append(ResidualSeries(conditioned, part, r[i], q[j]))
    return out


def _residuals(
    rig: Rig, conditioned: ConditionedRecord, model: ExactFit
) -> dict[str, tuple[Rows, Array]]:
    built = model_rows(rig, model.terms, conditioned)
    return {name: (rows, row_residual(rows, model.beta)) for name, rows in built.items()}


def abscissae(
    rig: Rig,
    lines: Sequence[ResidualSeries],
    effect: Effect | None,
    variable: str,
    equation: str,
    model: Model,
) -> Array:
    """Return the variable that an equation's residuals are plotted against, or the effect's."""
    joint = joint_of(equation)
    out = []
    for line in lines:
        if effect is not None:
            signals = prepared_signals(rig, model.terms, line.conditioned)
            raw = effect.abscissa(rig, signals)[equation]
        else:
            raw = variables(rig, line.conditioned.signals, joint)[variable]
        out.append(filtered({"x": np.asarray(raw)}, line.conditioned, line.rows)["x"])
    return np.concatenate(out)


def against(
    x: Array,
    lines: Sequence[ResidualSeries],
    noise: float,
    unit: str,
    label: str,
    key: str,
    after: bool,
) -> Markup:
    """Draw the residual over a variable, before next to after on one scale, with binned means."""
    parts = [("before: " if after else "", np.concatenate([line.before for line in lines]))]
    if after:
        parts.append(("after: ", np.concatenate([line.after for line in lines])))
    top = 1.1 * max(float(np.quantile(np.abs(parts[0][1]), 0.995)), 2.5 * noise)
    drawn = np.linspace(0, len(x) - 1, min(REPORT.scatter_points, len(x))).astype(int)
    with style():
        canvas = figure(2.5, CARD * (2 if after else 1))
        for k, (word, y) in enumerate(parts):
            axes = canvas.add_subplot(1, len(parts), k + 1)
            axes.axhspan(-noise, noise, color=PALE, alpha=0.7, lw=0)
            colour = BLUE if k else GREY
            axes.plot(x[drawn], y[drawn], ".", color=colour, ms=2.2, alpha=0.5, mew=0)
            means = _binned(x, y)
            axes.plot(*means, "-", color=MODEL, lw=1.8)
            axes.plot(*means, "o", color=MODEL, ms=2.6)
            axes.set_ylim(-top, top)
            axes.set_xlabel(label)
            if not k:
                axes.set_ylabel(f"residual [{unit}]")
            rms = float(np.sqrt(np.mean(y**2)))
            note(axes, 0.98, 0.98, f"{word}{fm.significant(rms)} {unit} rms", INK)
        canvas.tight_layout()
        return svg(canvas, key, f"Residual against {label}{_compared(after)}")


def curves(effect: JudgedEffect, key: str) -> Markup:
    """Draw the curves of a free form, each with its band."""
    with style():
        canvas = figure(2.4, CARD * 2)
        axes = canvas.add_subplot()
        for curve, colour in zip(effect.curves, (BLUE, MODEL, GREY, INK), strict=False):
            axes.fill_between(curve.x, curve.lo, curve.hi, color=colour, alpha=0.18, lw=0)
            axes.plot(curve.x, curve.y, color=colour, lw=1.6, label=curve.label)
        axes.set_xlabel(f"{effect.variable} [{effect.curves[0].unit_x}]")
        axes.set_ylabel(f"[{effect.curves[0].unit_y}]")
        if len(effect.curves) > 1:
            axes.legend(frameon=False)
        canvas.tight_layout()
        return svg(canvas, key, f"{effect.name.replace('_', ' ')} with its 95 % band")


def rival_errors(effect: JudgedEffect, key: str) -> Markup | None:
    """Draw the held-out error without an effect, with it, and with each rival in its place.

    Sorted by error, each with the reason why it is named or not. None where errors are unknown.
    """
    if not (np.isfinite(effect.rms_without) and np.isfinite(effect.rms_with)):
        return None
    bars = [
        ("without the effect", effect.rms_without, "", GREY),
        (_called(effect.name, effect.location), effect.rms_with, _verdict(effect), BLUE),
    ]
    bars += [
        (_called(r.name, r.location), r.ratio * effect.rms_with, *_against(r))
        for r in effect.rivals
    ]
    bars.sort(key=lambda bar: bar[1])
    high = 1.25 * max(2.0, *(bar[1] for bar in bars))
    low = 0.9 * min(1.0, *(bar[1] for bar in bars))
    with style():
        canvas = figure(0.5 + 0.4 * len(bars), CARD * 2)
        axes = canvas.add_subplot()
        for k, (name, error, why, colour) in enumerate(reversed(bars)):
            axes.barh(k, error - low, 0.36, left=low, color=colour, lw=0)
            axes.text(error, k, f" {fm.significant(error)}", va="center", fontsize=7.5)
            axes.plot([1.0, 1.0], [k - 0.2, k + 0.2], color=INK, lw=0.8, ls="--")
            text = f"{name}: {why}" if why else name
            line = textwrap.shorten(text, LINE_LENGTH, placeholder=" …")
            axes.annotate(
                line, (0.0, k + 0.22), xycoords=("axes fraction", "data"), va="bottom", fontsize=7.5
            )
        axes.set_xscale("log")
        axes.set_xlim(low, high)
        axes.xaxis.set_major_formatter(lambda v, _: f"{v:g}")
        axes.xaxis.set_minor_formatter(lambda v, _: f"{v:.1g}" if high < 10 * low else "")
        axes.set_yticks([])
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_visible(False)
        axes.set_ylim(-0.4, len(bars) - 0.4)
        axes.set_xlabel("held-out error over the noise of the repeats' mean (dashed)")
        canvas.tight_layout()
        return svg(
            canvas, key, f"Held-out error with {effect.name.replace('_', ' ')} and its rivals"
        )


def _called(name: str, where: str) -> str:
    return f"{name.replace('_', ' ')} at {where}"


def _verdict(effect: JudgedEffect) -> str:
    """Return that an effect is named, or the gates that it failed."""
    failed = [f"{g.name}: {g.detail}" for g in effect.gates if not g.ok]
    return f"not named ({'; '.join(failed)})".replace("_", " ") if failed else "named"


def _against(rival: Rival) -> tuple[str, str]:
    """Return why a rival is not named, and its colour."""
    if rival.tied:
        return "cannot be separated from it", ORANGE
    if rival.ratio <= TRACE.tie_ratio:
        times = fm.significant(rival.training_ratio)
        return f"ruled out: training error {times} times as large", PALE
    return f"ruled out: held-out error {fm.significant(rival.ratio)} times as large", PALE


def in_time(line: ResidualSeries, noise: float, unit: str, key: str, after: bool) -> Markup:
    """Draw a few seconds of the residual before and after."""
    t = line.rows.time
    shown = np.abs(t - 0.5 * (t[0] + t[-1])) <= 0.5 * REPORT.effect_seconds
    with style():
        canvas = figure(2.1, CARD * 2)
        axes = canvas.add_subplot()
        axes.axhspan(-noise, noise, color=PALE, alpha=0.7, lw=0)
        axes.plot(*gapped(t[shown], line.before[shown]), color=GREY, lw=1.1)
        if after:
            note(axes, 0.99, 0.97, "before", GREY)
            axes.plot(*gapped(t[shown], line.after[shown]), color=BLUE, lw=1.1)
            note(axes, 0.99, 0.84, "after", BLUE)
        axes.set_xlabel("time in the record [s]")
        axes.set_ylabel(f"residual [{unit}]")
        canvas.tight_layout()
        return svg(canvas, key, f"Held-out residual in time{_compared(after)}")


def over_noise(result: Trace, key: str = "overnoise") -> Markup:
    """Draw every equation's held-out error over its noise floor, before and after."""
    names = list(result.before)
    with style():
        canvas = figure(0.5 + 0.32 * len(names), CARD * 2)
        axes = canvas.add_subplot()
        for k, name in enumerate(reversed(names)):
            floor = result.noise_floor.get(name, np.nan)
            a, b = result.before[name] / floor, result.after.get(name, np.nan) / floor
            axes.plot([a, b], [k, k], "-", color=PALE, lw=5, solid_capstyle="round", zorder=1)
            axes.plot(a, k, "o", color=GREY, ms=6)
            axes.plot(b, k, "o", color=BLUE, ms=6)
        axes.axvline(1.0, color=INK, lw=0.8, ls="--")
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        # Less than an octave has no ticks, and noise would look like a difference.
        low, high = min(low, 0.8), max(high, 2.5)
        axes.set_xlim(low, high)
        axes.xaxis.set_major_formatter(lambda v, _: f"{v:g}")
        # Within one decade there are minor ticks only.
        axes.xaxis.set_minor_formatter(lambda v, _: f"{v:.1g}" if high < 10 * low else "")
        axes.set_yticks(range(len(names)), list(reversed(names)))
        axes.set_ylim(-0.6, len(names) - 0.4)
        colours = " (grey before, blue after)" if result.errors_changed else ""
        axes.set_xlabel(f"held-out error over the noise floor{colours}")
        canvas.tight_layout()
        title = f"Held-out error over the noise floor{_compared(result.errors_changed)}"
        return svg(canvas, key, title)


def _compared(changed: bool) -> str:
    """Return the end of the title of a figure that shows two models; '' for one model."""
    return ", before and after" if changed else ""


def spectrum(shown: Spectrum, unit: str, key: str, after: bool) -> Markup:
    """Draw the lines of a residual by kind, before next to after, and the noise of one repeat."""
    by_kind = lines_by_kind(shown.excited)
    kinds = (
        ("excited", by_kind[EXCITED], "o", INK, 4.0),
        ("odd, left empty", by_kind[ODD], "s", MODEL, 3.2),
        ("even", by_kind[EVEN] | by_kind[CONSTANT], "^", BLUE, 3.0),
    )
    noise = np.sqrt(shown.noise)
    low = 0.2 * float(np.median(noise))
    top = 2.0 * float(np.sqrt(max(shown.repeatable.max(), shown.noise.max())))
    with style():
        canvas = figure(2.6, CARD * (2 if after else 1))
        for k, word in enumerate(("before", "after") if after else ("before",)):
            axes = canvas.add_subplot(1, 2 if after else 1, k + 1)
            power = shown.after if k else shown.repeatable
            axes.fill_between(shown.frequency, low, np.maximum(noise, low), color=PALE, lw=0)
            for label, chosen, marker, colour, size in kinds:
                y = np.sqrt(np.maximum(power[chosen], 0.0))
                axes.plot(
                    shown.frequency[chosen], np.where(y > low, y, np.nan), marker, color=colour,
                    ms=size, mew=0, label=label,
                )  # fmt: skip
            axes.set_yscale("log")
            axes.set_ylim(low, top)
            axes.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
            axes.set_xlabel("frequency [Hz]")
            if not k:
                axes.set_ylabel(f"repeatable rms per line [{unit}]")
                axes.legend(loc="lower left", fontsize=7, ncols=3, handletextpad=0.2, frameon=False)
            if after:
                note(axes, 0.98, 0.98, word, INK)
        canvas.tight_layout()
        return svg(canvas, key, f"Lines of the residual{_compared(after)}")


def _binned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the means of x and of y in bins of equally many x."""
    order = np.argsort(x)
    count = min(REPORT.scatter_means, max(1, len(x) // 5))
    parts = [p for p in np.array_split(order, count) if len(p)]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts])


def axis(rig: Rig, name: str) -> tuple[str, float]:
    """Return an axis label of a variable with its display unit, and the factor from SI.

    `name` is that of a channel, of a variable of clues, or of an effect's plotted quantity.
    """
    shown = display_unit(_unit_of_variable(rig, name), AXES)
    return f"{name} [{typeset(shown.text)}]", shown.scale


def _unit_of_variable(rig: Rig, name: str) -> str:
    with suppress(ValueError):  # no channel
        return rig.unit_of(name)
    position = rig.unit_of(ch.channel(rig.position_kind, 1))
    spool, pressure = ch.UNITS[ch.SPOOL], ch.UNITS[ch.SUPPLY]
    drive = rig.unit_of(ch.channel(rig.drive_kind, 1))
    return {
        "position": position, "velocity": f"{position}/s", "acceleration": f"{position}/s^2",
        "joint position": position if rig.electric else "rad", "absolute angle": "rad",
        "spool": spool, "spool rate": f"{spool}/s", "drive": drive, "drive rate": f"{drive}/s",
        "pressure": pressure, "pressure difference": pressure,
        "pressure across the leak": pressure, "pressure rate": f"{pressure}/s",
        "flow drawn": "m^3/s", "flow returned": "m^3/s", "time": "s",
    }[name.rstrip("_0123456789").replace("_", " ")]  # fmt: skip


def equation_of(
    effect: Effect, rig: Rig, result: Trace, lines: Mapping[str, Sequence[ResidualSeries]]
) -> str:
    """Return the equation with the largest ratio of residual to noise before an effect is added."""
    conditioned = next(iter(lines.values()))[0].conditioned
    equations = [e for e in effect.abscissa(rig, conditioned.signals) if e in lines]
    if not equations:
        return equation_of_largest_reduction(result)
    return max(equations, key=lambda e: result.before[e] / max(result.noise_floor[e], 1e-30))
