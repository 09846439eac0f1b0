"""A trace as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from analysis.trace.data.spectral_lines import largest_residual_lines
from analysis.trace.loop_rounds import Round
from analysis.trace.result import JudgedEffect, Trace
from analysis.trace.words import free_run_row, numbers_in_words, shot_in_words, unit_of_equation
from rig.cli.text.output import table
from rig.model.channels import place_in_words
from rig.model.rig import Rig
from rig.model.units import RESULTS, display_unit, plain, typeset

RIVALS_SHOWN: Final = 8  # of an effect, the nearest; the report and the JSON have all of them


def trace_text(result: Trace) -> str:
    """Return verdict, effects with their tests, errors, clues and the next experiment as text."""
    rig = result.model_before.rig
    lines = [f"verdict: {result.verdict}", "", result.sentence, ""]
    for effect in result.effects:
        lines += _effect(effect, rig)
    for effect in result.refused:
        lines += ["fitted best, but not named:", *_effect(effect, rig)]
    lines += [_errors(result), ""]
    if result.fit_before:
        lines += [_free_runs(result), ""]
    changed = _changed(result) if result.changed else []
    if changed:
        lines += [table(["parameter", "before", "after", "unit", "change"], changed), ""]
    lines += [
        f"spectral lines: {lines_of_equation.text}"
        for lines_of_equation in largest_residual_lines(result.lines)
    ]
    if result.depends_on:
        causes = ", ".join(f"{d.text} ({100 * d.share:.0f} %)" for d in result.depends_on[:4])
        lines.append(f"the remaining residual depends on: {causes} (a clue, not a named effect)")
    lines += [
        f"a sparse fit of the remaining residual of {f.equation}: {f.text} "
        f"({100 * f.share:.0f} % of its energy on held-out records; a clue, not a named effect)"
        for f in result.formulas
    ]
    if result.next_experiment:
        lines.append(f"next experiment: {result.next_experiment['text']}")
    lines += [f"note: {note}" for note in result.notes]
    lines.append(f"traced in {result.seconds:.1f} s")
    return "\n".join(lines)


def _errors(result: Trace) -> str:
    """Return the held-out errors as a table, once where no effect changes them."""
    models = (result.before, result.after)[: 2 if result.errors_changed else 1]
    rows = [
        [
            name, _number(result.noise_floor.get(name, math.nan), 2),
            *(_number(errors.get(name, math.nan), 2) for errors in models),
            unit_of_equation(result.model_before.rig, name),
            *(_share(errors.get(name), result.size.get(name)) for errors in models),
        ]
        for name in result.before
    ]  # fmt: skip
    words = ["before", "after"] if result.errors_changed else ["rms"]
    relative = ["relative before", "after"] if result.errors_changed else ["relative"]
    return table(["held-out error", "noise floor", *words, "unit", *relative], rows)


def _free_runs(result: Trace) -> str:
    """Return the held-out free runs as a table, once where nothing was added to the model."""
    figures: tuple[str, ...] = ("FIT", "RMSE", "in 0.25 s")
    if result.changed:
        figures = tuple(word for f in figures for word in (f"{f} before", "after"))
    rows = [_free_run(result, name) for name in result.fit_before]
    return table(["held-out free run", *figures, "unit"], rows)


def _share(error: float | None, size: float | None) -> str:
    """Return an error in percent of the rms of the equation's right side."""
    return f"{100 * error / size:.1f} %" if error is not None and size else ""


def _effect(effect: JudgedEffect, rig: Rig) -> list[str]:
    numbers = ", ".join(numbers_in_words(effect, rig))
    lines = [f"{effect.name} at {effect.location}{f': {numbers}' if numbers else ''}"]
    if effect.shot:
        lines.append(f"  {shot_in_words(effect)}")
    lines += [f"  {'ok    ' if g.ok else 'NOT OK'} {g.name}: {g.detail}" for g in effect.gates]
    lines += [
        f"  rival {r.name} at {r.location}: {r.ratio:.2f} times the held-out rms"
        + (" (cannot be separated)" if r.tied else "")
        for r in effect.rivals[:RIVALS_SHOWN]
    ]
    further = effect.rivals[RIVALS_SHOWN:]
    if further:
        tied = sum(r.tied for r in further)
        lines.append(f"  and {len(further)} further rivals, {tied} of which cannot be separated")
    return [*lines, ""]


def _changed(result: Trace) -> list[list[str]]:
    after = result.model_after.parameters
    out = []
    for name, estimate in result.model_before.parameters.items():
        if name not in after:
            continue
        change = 100 * (after[name].value / estimate.value - 1) if estimate.value else math.nan
        unit = display_unit(estimate.unit, RESULTS)
        values = (_number(unit.scale * p.value, 4) for p in (estimate, after[name]))
        out.append([name, *values, typeset(unit.text), _percent(change, "+")])
    return out


def _percent(value: float, sign: str = "") -> str:
    if not math.isfinite(value):
        return "—"
    shown = round(value, 1) + 0.0  # never -0.0
    return f"{shown:{sign if shown else ''}.1f} %"


def _free_run(result: Trace, channel: str) -> list[str]:
    fits, errors, unit = free_run_row(result, channel)
    step = 1 if result.changed else 2  # pairs of before and after
    return [channel, *map(_percent, fits[::step]), *map(_number, errors[::step]), unit]


def _number(value: float, digits: int = 3) -> str:
    return plain(value, digits) if math.isfinite(value) else "—"


def rounds_text(rounds: Sequence[Round], stopped: str) -> str:
    """Return a loop's rounds as a table, the last trace, and why the loop stopped."""
    rows = [
        [
            str(r.number), r.result.verdict, named(r.result), _figure(r.predicted),
            _figure(r.achieved), plain(r.baseline_ratio, 2), plain(r.residual, 2),
        ]
        for r in rounds
    ]  # fmt: skip
    header = [
        "round", "verdict", "named", "predicted", "achieved", "residual/noise", "held-out/noise",
    ]  # fmt: skip
    lines = [trace_text(rounds[-1].result), "", table(header, rows), "", f"stopped: {stopped}"]
    return "\n".join(lines)


def named(result: Trace) -> str:
    """Return the effects of a trace in a few words, with those that cannot be separated."""
    names = [f"{e.name} at {e.location}" for e in result.effects]
    tied = ", ".join(f"{name} at {place_in_words(at)}" for name, at in result.tied_at)
    return (", ".join(names) or "nothing") + (f" (or {tied})" if tied else "")


def _figure(value: float | None) -> str:
    return "—" if value is None else plain(value, 2)
