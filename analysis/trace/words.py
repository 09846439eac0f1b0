"""The trace's result in plain words."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from analysis.simulation.model import Estimate
from analysis.trace.clues.formula import surest_formula
from analysis.trace.judge.gates import form_share
from analysis.trace.notes import WITHOUT_RESTS
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, Curve, JudgedEffect, Trace
from analysis.trace.search.hypothesis import effect_of
from analysis.trace.settings import TRACE
from rig.model.channels import place_in_words
from rig.model.rig import Rig
from rig.model.units import RESIDUALS, display_unit, plain, typeset, with_interval

LOPSIDED: Final = 1.3  # of an interval's shorter side, beyond which its ends are stated

UNITS = {"torque": "N·m", "flow_cap": "m³/s", "flow_rod": "m³/s"}


def unit_of_equation(rig: Rig, equation: str) -> str:
    """Return the unit of an equation's residual; the torque row of a sliding joint is a force."""
    kind = equation.rsplit("_", 1)[0]
    if kind == "torque" and getattr(rig, "prismatic", False):
        return "N"
    return UNITS.get(kind, "")


def free_run_row(result: Trace, channel: str) -> tuple[list[float], list[float], str]:
    """Return a channel's FIT [%], its RMSE over records and over 0.25 s, and the unit of these.

    Each is of the model before and after, NaN where it could not be simulated.
    """
    unit = display_unit(result.model_before.rig.unit_of(channel), RESIDUALS)
    errors = (
        result.rmse_before, result.rmse_after, result.window_before, result.window_after,
    )  # fmt: skip
    fits = [fit.get(channel, math.nan) for fit in (result.fit_before, result.fit_after)]
    return fits, [unit.scale * error.get(channel, math.nan) for error in errors], unit.text


def sentence(result: Trace) -> str:
    """Return the verdict, the effects and the errors of a trace in one paragraph."""
    if result.verdict == CLEAN:
        return (
            "No residual exceeds the noise: the baseline model explains these records; no effect "
            "is named."
        )
    named = "; ".join(_effect_in_words(e, result.model_before.rig) for e in result.effects)
    remarks = [*_open_number_remarks(result), *_tolerated_error(result)]
    errors = " ".join([_error_reduction(result), *remarks]).strip()
    if result.verdict == EXPLAINED:
        return f"{_variables_in_words(result.effects)}: {named}. {errors}"
    if result.verdict == CONFOUNDED:
        rivals = ", ".join(
            f"{name.replace('_', ' ')} at {place_in_words(at)}" for name, at in result.tied_at
        )
        text = f"The best fit is {named}, but these records cannot separate it from {rivals}."
        if result.next_experiment:
            text += f" An experiment that separates them: {result.next_experiment['text']}."
        return f"{text} {errors}"
    prefix = f"Effects found: {named}. " if named else "No effect of the catalogue is named. "
    if not named and result.unexplained_fraction == 0.0:
        return (
            f"{prefix}The training records are met to within the noise, the held-out ones are not. "
            f"{_largest_errors(result)}"
        )
    clue, best = ", ".join(d.text for d in result.depends_on[:2]), surest_formula(result.formulas)
    share = f"{plain(100 * result.unexplained_fraction, 2)} % of the repeatable residual energy"
    remains = f"{share} remains unexplained"
    if result.unexplained_fraction <= TRACE.held_out_share:
        remains = f"{share} remains in the training records, more in the held-out ones"
    return (
        f"{prefix}{remains}"
        + (f"; it depends on {clue}" if clue else "")
        + _symmetry(result)
        + (f"; a sparse fit is {best.text}" if best else "")
        + (f". {errors}" if named else f". {_largest_errors(result)}")
    )


def _largest_errors(result: Trace) -> str:
    """State the held-out errors of the two equations that keep most, over their noise floors."""
    ratios = {e: result.after[e] / floor for e, floor in result.noise_floor.items() if floor > 0}
    largest = sorted(ratios, key=lambda e: -ratios[e])[:2]
    errors = " and ".join(f"{plain(ratios[e], 3)} in {e}" for e in largest)
    in_noise = all(ratio <= TRACE.noted_ratio for ratio in ratios.values())
    only_trained = "; what is above it is in other rows (see the notes)" if in_noise else ""
    return f"Held-out errors over the noise floor: {errors}{only_trained}."


def _symmetry(result: Trace) -> str:
    """Say what spectral lines show of the largest remaining residual ('' if none exceeds noise)."""
    largest = max(result.lines, key=lambda lines: lines.above_noise_after, default=None)
    if largest is None or largest.above_noise_after < 1.0:
        return ""
    return f"; its spectral lines in {largest.equation} show that it is {largest.meaning_after}"


def _variables_in_words(effects: tuple[JudgedEffect, ...]) -> str:
    named = [e.variable for e in effects if e.variable and not e.variable.startswith("nothing")]
    variables = list(dict.fromkeys(named))
    if len(named) < len(effects) and variables:
        variables.append("a constant")
    return "The residual follows " + " and ".join(variables) if variables else "Explained"


def _effect_in_words(effect: JudgedEffect, rig: Rig) -> str:
    numbers = ", ".join(numbers_in_words(effect, rig))
    return f"{effect.name.replace('_', ' ')} at {effect.location} ({numbers})"


def numbers_in_words(effect: JudgedEffect, rig: Rig) -> list[str]:
    """Return an effect's numbers; of a free curve its range instead of values at knots.

    Of a shape that may lie anywhere between its bounds only that is stated.
    """
    term = effect_of(effect.name, effect.at or effect.where)
    hidden = {c.parameter for c in term.coefficients(rig)} if effect.free else set()
    bounds = {s.parameter: (s.low, s.high) for s in term.shapes(rig)}
    values = [_curve_range(c) for c in effect.curves if effect.free]
    for n, e in effect.parameters.items():
        if n in hidden:
            continue
        if not _undetermined(effect, n):
            values.append(f"{n} = {quantity(e)}")
        elif n in bounds and e.ci95[0] <= bounds[n][0] and e.ci95[1] >= bounds[n][1]:
            values.append(f"{n} not determined")
        else:
            values.append(f"{n} not determined: {quantity(e)}")
    return values


def _curve_range(curve: Curve) -> str:
    """Return the range of a curve's values and that of its variable, in words."""
    ends = (np.min(curve.y), np.max(curve.y), curve.x[0], curve.x[-1])
    low, high, first, last = (plain(v, 3) for v in ends)
    y, x = typeset(curve.unit_y), typeset(curve.unit_x)
    return f"{curve.label}: {low} to {high} {y} between {first} and {last} {x}"


def _undetermined(effect: JudgedEffect, name: str) -> bool:
    """Return whether a number is less certain than the effect's largest one of its unit.

    One whose interval excludes 0 is known to a factor.
    """
    estimate = effect.parameters[name]
    if estimate.ci95[0] * estimate.ci95[1] > 0.0:
        return False
    alike = [e.value for e in effect.parameters.values() if e.unit == estimate.unit]
    return estimate.half > max(map(abs, alike))


def _open_number_remarks(result: Trace) -> list[str]:
    """Return the notes on numbers of the effects that the records do not determine."""
    open_numbers = [
        f"{e.name}: {name} " for e in result.effects for name in e.parameters
        if _undetermined(e, name)
    ]  # fmt: skip
    remarks = [n for n in result.notes if n.startswith(tuple(open_numbers))] if open_numbers else []
    return [f"{remark.partition(': ')[2]}." for remark in remarks]


def _tolerated_error(result: Trace) -> list[str]:
    """State the largest error of an explanation above the noise, and why it is tolerated."""
    above_floor = [e for e in result.above_floor if result.remaining_share(e) < 1.0]
    if result.verdict not in (EXPLAINED, CONFOUNDED) or not above_floor:
        return []
    e = above_floor[0]
    share = result.remaining_share(e)
    why = f"the form of a named effect may miss {plain(100 * TRACE.held_out_share, 2)} %"
    if any(note.startswith(f"{e}: {WITHOUT_RESTS}") for note in result.notes):
        why = "it includes the samples at which the joint rests, which are not judged"
    elif share > _form_share(result, e):
        why = "in the records that choose, the error is within the band of an explanation"
    return [
        f"What is left in {e}, {result.after[e] / result.noise_floor[e]:.1f} times the noise "
        f"floor, is {plain(100 * share, 2)} % of the energy that was above the noise: {why}."
    ]


def _form_share(result: Trace, equation: str) -> float:
    effects = [effect_of(effect.name, effect.at or effect.where) for effect in result.effects]
    return form_share(result.model_before.rig, effects, equation)


def tolerated_error_notes(result: Trace) -> list[str]:
    """Return notes on held-out errors of an explanation above `TRACE.noted_ratio` noise floors.

    Equations of which a note of the result speaks already are left out.
    """
    if result.verdict not in (EXPLAINED, CONFOUNDED):
        return []
    out = []
    for e in result.above_floor:
        if any(note.startswith(f"{e}:") for note in result.notes):
            continue
        share = result.remaining_share(e)
        why = "no less than under the baseline: no named effect acts in it"
        if share < 1.0:
            why = f"{plain(100 * share, 2)} % of the baseline's energy above noise, "
            why += (
                "within the tolerance for the form of the named effect"
                if share <= _form_share(result, e)
                else "within the band in the records that choose"
            )
        times = result.after[e] / result.noise_floor[e]
        out.append(f"{e}: held-out error {times:.2f} times the noise floor, {why}")
    return out


def quantity(estimate: Estimate) -> str:
    """Return value ± 95 % half-width with its unit, or value and ends of an asymmetric interval."""
    low, high = estimate.ci95
    sides, unit = (estimate.value - low, high - estimate.value), typeset(estimate.unit)
    if max(sides) > LOPSIDED * min(sides) > 0.0:
        # Two digits, and more where the ends would be shown as equal.
        digits = 2 + max(0, math.floor(math.log10(max(abs(low), abs(high)) / (high - low))))
        value, low_end, high_end = (plain(x, digits) for x in (estimate.value, low, high))
        return f"{value} ({low_end} to {high_end}) {unit}".strip()
    return with_interval(estimate.value, estimate.half, unit)


def shot_in_words(effect: JudgedEffect) -> str:
    """Return an effect's shapes from multiple shooting in words ('' without a hidden state)."""
    if effect.shot is None:
        return ""
    shot = effect.shot
    values = ", ".join(f"{n} = {quantity(e)}" for n, e in shot.shapes.items())
    which = (
        "taken"
        if shot.taken
        else ("the values from the rows are kept, with an interval that contains both")
    )
    judged = "held-out windows do not decide which is closer"
    if np.isfinite([shot.before, shot.after]).all():
        judged = f"held-out windows {shot.before:.2f} → {shot.after:.2f} times the sensors' noise"
    return f"by multiple shooting {values}; {judged}: {which}"


def equation_of_largest_reduction(result: Trace) -> str:
    """Return the equation whose held-out energy fell most, in units of its noise."""

    def fall(e: str) -> float:
        now = result.after.get(e, float("nan"))
        return (result.before[e] ** 2 - now**2) / max(result.noise_floor.get(e, 0.0), 1e-30) ** 2

    return max(result.before, key=fall)


def _error_reduction(result: Trace) -> str:
    if not result.before:
        return ""
    e = equation_of_largest_reduction(result)
    unit = unit_of_equation(result.model_before.rig, e)
    before, after, floor = (
        plain(error.get(e, float("nan")), 2)
        for error in (result.before, result.after, result.noise_floor)
    )
    return f"Held-out error of {e}: {before} → {after} {unit}, noise floor {floor}."
