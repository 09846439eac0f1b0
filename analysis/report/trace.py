"""The trace's report: one HTML page with figures, effects and errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from analysis.effects.base import Effect
from analysis.report import format as fm
from analysis.report.identification.report import Provenance
from analysis.report.page import page
from analysis.report.plots import place_plot, trace_plots
from analysis.simulation.model import Estimate
from analysis.trace.clues.dependence import FREQUENCY
from analysis.trace.data.spectral_lines import largest_residual_lines
from analysis.trace.result import CLEAN, CONFOUNDED, JudgedEffect, Trace
from analysis.trace.words import free_run_row, quantity, shot_in_words, unit_of_equation
from rig.model.channels import place_in_words
from rig.model.records import Run
from rig.model.rig import Rig

TEMPLATE = "trace.html"
TITLES = {
    "clean": "No residual above the noise",
    "explained": "The missing effects are named",
    "confounded": "Two or more effects fit equally well",
    "unexplained": "An effect that the catalogue does not have",
}


def render(holdout: Sequence[Run], result: Trace, provenance: Provenance | None = None) -> str:
    """Return the report as HTML text."""
    return page(TEMPLATE, body(holdout, result, provenance))


def body(
    holdout: Sequence[Run], result: Trace, provenance: Provenance | None = None
) -> dict[str, Any]:
    """Return the template's context for a trace, for `analysis.report.page.page`."""
    rig = result.model_before.rig
    return {
        "title": TITLES[result.verdict],
        "rig": rig,
        "result": result,
        "provenance": provenance or Provenance(),
        "galleries": _pictures(rig, holdout, result),
        "overview": trace_plots.over_noise(result),
        "places": place_plot.places(result),
        "errors": _errors(result),
        "effects": [_effect(e, f"d{k}") for k, e in enumerate(result.effects)],
        "refused": [_effect(e, f"n{k}") for k, e in enumerate(result.refused)],
        "parameters": _parameters(result),
        "fits": [_free_run(result, channel) for channel in result.fit_before],
        "floors": [(f, unit_of_equation(rig, f.equation)) for f in result.floors],
        "spectra": _spectra(rig, result),
        "fm": fm,
    }


def _free_run(result: Trace, channel: str) -> tuple[str, ...]:
    fits, errors, unit = free_run_row(result, channel)
    return channel, *map(fm.fit, fits), *map(fm.significant, errors), unit


def _pictures(rig: Rig, holdout: Sequence[Run], result: Trace) -> list[dict[str, Any]]:
    """Return, per effect and per clue, the residual against its variable and in time."""
    lines = trace_plots.held_out(rig, holdout, result)
    out: list[dict[str, Any]] = []

    def add(effect: Effect | None, variable: str, equation: str, heading: str, key: str) -> None:
        timed = equation not in [picture["equation"] for picture in out]  # each figure once
        drawn = _pair(rig, lines[equation], result, effect, variable, equation, key, timed)
        out.append({"heading": heading, "equation": equation, **drawn})

    baseline = {(u.term.name, u.term.where) for u in result.model_before.terms}
    effects = [
        u.term
        for u in result.model_after.terms
        if isinstance(u.term, Effect) and (u.term.name, u.term.where) not in baseline
    ]
    for k, effect in enumerate(effects):
        equation = trace_plots.equation_of(effect, rig, result, lines)
        heading = f"{effect.name.replace('_', ' ')} at {place_in_words(effect.where)}"
        add(effect, effect.plotted(), equation, heading, f"e{k}")
    # A frequency is visible over time and in the lines only; noise depends on no variable.
    drawn = [
        d for d in result.depends_on
        if d.variable != FREQUENCY
        and (result.verdict != CONFOUNDED or d.equation in result.above_floor)
    ][:2]  # fmt: skip
    for k, clue in enumerate(drawn):
        heading = f"remaining residual of {clue.equation} against {clue.variable}"
        add(None, clue.variable, clue.equation, heading, f"c{k}")
    return out


def _pair(
    rig: Rig, lines: Sequence[trace_plots.ResidualSeries], result: Trace, effect: Effect | None,
    variable: str, equation: str, key: str, timed: bool,
) -> dict[str, Any]:  # fmt: skip
    unit = unit_of_equation(rig, equation)
    noise, changed = result.noise_floor[equation], result.changed
    label, scale = trace_plots.axis(rig, variable)
    x = scale * trace_plots.abscissae(rig, lines, effect, variable, equation, result.model_after)
    largest = max(lines, key=lambda line: float((line.before**2).mean()))
    return {
        "text": f"{equation}, held-out records; the band is ± one rms of noise, red the mean.",
        "against": trace_plots.against(x, lines, noise, unit, label, f"{key}x", changed),
        "time": trace_plots.in_time(largest, noise, unit, f"{key}t", changed) if timed else None,
        "record": largest.conditioned.record.name,
    }


def _spectra(rig: Rig, result: Trace) -> list[dict[str, Any]]:
    """Return the lines of the largest residuals: figures and captions."""
    return [
        {
            "text": lines.text,
            "figure": trace_plots.spectrum(
                lines, unit_of_equation(rig, lines.equation), f"l{k}", result.changed
            ),
        }
        for k, lines in enumerate(largest_residual_lines(result.lines))
    ]


def _errors(result: Trace) -> list[tuple[str, ...]]:
    rig = result.model_before.rig
    out: list[tuple[str, ...]] = []
    for name, before in result.before.items():
        floor, after = result.noise_floor.get(name, math.nan), result.after.get(name, math.nan)
        out.append(
            (
                name, unit_of_equation(rig, name), fm.significant(floor),
                fm.significant(before), fm.significant(after),
                fm.significant(before / floor), fm.significant(after / floor),
            )
        )  # fmt: skip
    return out


def _effect(effect: JudgedEffect, key: str) -> dict[str, Any]:
    return {
        "curve": trace_plots.curves(effect, key) if effect.curves else None,
        "tried": trace_plots.rival_errors(effect, f"{key}r"),
        "name": effect.name.replace("_", " "),
        "where": effect.location,
        "values": [(n, quantity(e)) for n, e in effect.parameters.items()],
        "p": fm.significant(effect.p_value),
        "removed": fm.significant(100 * effect.removed_fraction),
        "shot": shot_in_words(effect),
        "gates": effect.gates,
        "rivals": [
            (
                r.name.replace("_", " "), r.location, fm.significant(r.ratio),
                fm.significant(r.training_ratio), "cannot be separated" if r.tied else "ruled out",
            )
            for r in effect.rivals
        ],
    }  # fmt: skip


def _parameters(result: Trace) -> list[tuple[str, ...]]:
    """Return rows of name, value before and after, their change, and unit."""
    if result.verdict == CLEAN or not result.changed:
        return []
    after = result.model_after.parameters
    out: list[tuple[str, ...]] = []
    for name, estimate in result.model_before.parameters.items():
        if name in after and estimate.identified and after[name].identified:
            unit = fm.display_unit(estimate.unit)
            values = (quantity(_scaled(e, unit.scale)) for e in (estimate, after[name]))
            out.append((name, *values, _change(estimate.value, after[name].value), unit.text))
    return out


def _scaled(estimate: Estimate, scale: float) -> Estimate:
    """Return an estimate times `scale`, without its unit."""
    low, high = estimate.ci95
    return Estimate(
        scale * estimate.value, "", scale * estimate.std, (scale * low, scale * high), estimate.note
    )


def _change(before: float, after: float) -> str:
    """Return the relative change of a value in percent, a dash for one that was 0."""
    if not before:
        return fm.DASH
    change = 100.0 * (after / before - 1.0)
    text = fm.fixed(change, 1)
    return f"+{text} %" if change > 0.0 and text != "0.0" else f"{text} %"
