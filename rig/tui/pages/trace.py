"""Before and after of a trace: verdict, effects, errors, and a free run of both models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from rig.model.units import plain, typeset, with_interval
from rig.tui.drawing.braille import Array
from rig.tui.drawing.plot import GUTTER, PlotTrace, draw
from rig.tui.drawing.rows import Part, Row, block, columns, fit, hstack, row, wrapped
from rig.tui.drawing.styles import DIM, STRONG, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.pages.parts import WIDE
from rig.tui.recorded_run import StoredCurves, StoredEffect, StoredEstimate, StoredTrace
from rig.tui.units import shown

PLOT: Final = 6  # rows of a plot below it
UNITS: Final = {"torque": "N·m", "force": "N", "flow": "m³/s"}  # by the first word of an equation
SYMBOLS: Final = {"clean": "●", "explained": "●", "confounded": "▲", "unexplained": "▲"}


def run_trace_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the stored trace of a run."""
    trace = view.browsed.trace
    if trace is None:
        return block([row((" no run was opened", DIM))], width, height)
    head = [fit(row((f" {trace.path or trace.folder}", STRONG)), width)]
    if trace.stored is None:
        status = "reading ..." if trace.reading else trace.trouble
        style = DIM if trace.reading else WARN_TEXT
        return block([*head, *wrapped(f" {status}", width, style)], width, height)
    room = height - len(head)
    beside_it = width >= WIDE
    left = width * 11 // 20 if beside_it else width
    text = trace_text_rows(trace.stored, left - 1)
    if beside_it:
        right = width - left - 1
        plots = free_run_rows(trace.stored, view.look.channel, right, room)
        text = text[min(view.look.offset, max(len(text) - room, 0)) :]
        return [*head, *hstack([(text, left), (plots, right)], room)]
    text += [row(), *free_run_rows(trace.stored, view.look.channel, width, 2 * PLOT + 4)]
    at = min(view.look.offset, max(len(text) - room, 0))
    return [*head, *block(text[at:], width, room)]


def trace_text_rows(stored: StoredTrace, width: int) -> list[Row]:
    """Return verdict, effects, errors before and after, fits, and what to do next."""
    verdict = f" {SYMBOLS.get(stored.verdict, '▲')} {stored.verdict.upper()}"
    rows: list[Row] = [fit(row((verdict, STRONG)), width)]
    rows += wrapped(f" {stored.sentence}", width)
    for effect in stored.effects:
        rows += _effect(effect, width)
    for effect in stored.refused:
        rows += _refused(effect, width)
    rows += [row(), *_errors(stored), *_fits(stored)]
    if stored.next_experiment is not None and stored.next_experiment.text:
        rows += [row(), *wrapped(f" next: {stored.next_experiment.text}", width)]
    for note in stored.notes:
        rows += wrapped(f" note: {note}", width, DIM)
    return [fit(line, width) for line in rows]


def _effect(effect: StoredEffect, width: int) -> list[Row]:
    removed = effect.removed_fraction
    share = f"   removes {removed:.0%}" if removed is not None else ""
    name = effect.name.replace("_", " ")
    rows: list[Row] = [
        row((f" ▸ {name}", STRONG), (f" at {effect.location}", STRONG), (share, DIM))
    ]
    for key, value in effect.parameters.items():
        rows += wrapped(f"     {key} = {estimate_text(value)}", width)
    return rows


def _refused(effect: StoredEffect, width: int) -> list[Row]:
    failed = next((gate for gate in effect.gates if not gate.ok), None)
    cause = f": {failed.name}, {failed.detail}" if failed is not None else ""
    name = effect.name.replace("_", " ")
    return wrapped(f"   fitted best, but not named: {name} at {effect.location}{cause}", width, DIM)


def estimate_text(estimate: StoredEstimate) -> str:
    """Return a value with half its 95 % interval and its unit."""
    low, high = estimate.ci95
    if estimate.value is None:
        return "not identified"
    half = 0.5 * (high - low) if low is not None and high is not None else math.nan
    return with_interval(estimate.value, half, typeset(estimate.unit))


def _errors(stored: StoredTrace) -> list[Row]:
    """Return the held-out errors: noise floor, before, after, and both over the floor.

    A model that did not change has one error.
    """
    models = ("before", "after") if stored.changed else ("rms",)
    words = ("held-out rms", "floor", *models, "unit", "over floor")
    cells: list[list[str | Part]] = [[(f" {word}", DIM) for word in words]]
    for name, before in stored.error.before.items():
        floor, after = stored.error.noise_floor.get(name), stored.error.after.get(name)
        errors = (before, after)[: len(models)]
        over = f" {' → '.join(_over(error, floor) for error in errors)}"
        numbers = [f" {_number(value)}" for value in (floor, *errors)]
        cells.append([f" {name}", *numbers, f" {UNITS.get(name.split('_')[0], 'SI')}", over])
    return columns(cells)


def _fits(stored: StoredTrace) -> list[Row]:
    if not stored.fit.before:
        return []
    models = ("FIT before", "after") if stored.changed else ("FIT",)
    cells: list[list[str | Part]] = [[(f" {word}", DIM) for word in ("held-out free run", *models)]]
    for name, before in stored.fit.before.items():
        fits = (before, stored.fit.after.get(name))[: len(models)]
        cells.append([f" {name}", *(f" {_percent(share)}" for share in fits)])
    return [row(), *columns(cells)]


def free_run_rows(stored: StoredTrace, chosen: int, width: int, height: int) -> list[Row]:
    """Return a channel's error in free runs of the models before and after, on one scale."""
    run = stored.free_run
    if run is None or not run.channels or len(run.time) < 2:
        text = " No free run is stored: not every parameter is identified, or the trace is older."
        return wrapped(text, width, DIM)
    names = list(run.channels)
    name = names[min(chosen, len(names) - 1)]
    curves = run.channels[name]
    form = shown(curves.unit)
    before, after = errors_of(curves)
    time = np.array(run.time)
    largest = float(np.nanmax(np.abs(np.concatenate((before, after, [0.0])))))
    ends = (-largest, largest) if largest > 0.0 else (None, None)
    what = f"  free run minus measured, {run.record} [{form.unit}]"
    head = row((f" {name}", STRONG), (what, DIM))
    errors = (("before", before), ("after", after)) if stored.changed else (("error", before),)
    each = max((height - 3) // len(errors) - 1, 1)
    rows: list[Row] = [fit(head, width)]
    for word, error in errors:
        finite = error[np.isfinite(error)]
        rms = float(np.sqrt(np.mean(finite**2))) if len(finite) else math.nan
        title = row((f" {word}", STRONG), (f"  rms {plain(form.factor * rms, 3)} {form.unit}", DIM))
        trace = PlotTrace(time, error, error, float(time[0]), float(time[-1]), ends, form)
        rows += [fit(title, width), *draw(trace, width, each)]
    first, last = (f"{at:.3g} s" for at in (time[0], time[-1]))
    axis = f"{' ' * GUTTER}{first:<{max(width - GUTTER - len(last), 0)}}{last}"
    return [*rows, fit(row((axis, DIM)), width)][:height]


def errors_of(curves: StoredCurves) -> tuple[Array, Array]:
    """Return (before, after), each (n,): the free runs' deviations from the measurement, SI."""
    measured = _array(curves.measured)
    return _array(curves.before) - measured, _array(curves.after) - measured


def _array(values: Sequence[float | None]) -> Array:
    return np.array([math.nan if value is None else value for value in values])


def _over(error: float | None, floor: float | None) -> str:
    return f"{error / floor:.1f}×" if error is not None and floor else "–"


def _number(value: float | None) -> str:
    return "–" if value is None else plain(value, 2)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f} %"
