"""The trace's result in plain words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.simulation.model import Estimate
from analysis.trace.clues.formula import surest_formula
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, JudgedEffect, Trace
from rig.model.channels import place_in_words
from rig.model.rig import Rig
from rig.model.units import plain, typeset, with_interval

UNITS = {"torque": "N·m", "flow_cap": "m³/s", "flow_rod": "m³/s"}


def unit_of_equation(rig: Rig, equation: str) -> str:
    """Return the unit of an equation's residual; the torque row of a sliding joint is a force."""
    kind = equation.rsplit("_", 1)[0]
    if kind == "torque" and getattr(rig, "prismatic", False):
        return "N"
    return UNITS.get(kind, "")


def sentence(result: Trace) -> str:
    """Return the verdict, the effects and the errors of a trace in one paragraph."""
    if result.verdict == CLEAN:
        return (
            "No residual exceeds the noise: the baseline model explains these records; no effect "
            "is named."
        )
    named = "; ".join(_effect(e) for e in result.effects)
    errors = _errors(result)
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
    clue = ", ".join(d.text for d in result.depends_on[:2])
    return (
        f"{prefix}{100 * result.unexplained_fraction:.0f} % of the repeatable residual energy "
        "remains unexplained"
        + (f"; it depends on {clue}" if clue else "")
        + _symmetry(result)
        + _formula(result)
        + (f". {errors}" if named else ".")
    )


def _formula(result: Trace) -> str:
    """Return the sure formula that leaves least, in words ('' where none is sure)."""
    best = surest_formula(result.formulas)
    return f"; a sparse fit is {best.text}" if best else ""


def _symmetry(result: Trace) -> str:
    """Say what spectral lines show of the largest remaining residual ('' if none exceeds noise)."""
    loud = max(result.lines, key=lambda lines: lines.above_noise_after, default=None)
    if loud is None or loud.above_noise_after < 1.0:
        return ""
    return f"; its spectral lines in {loud.equation} show that it is {loud.meaning_after}"


def _variables_in_words(effects: tuple[JudgedEffect, ...]) -> str:
    variables = [e.variable for e in effects if e.variable and not _constant(e.variable)]
    if len(variables) < len(effects) and variables:
        variables.append("a constant")
    return "The residual follows " + " and ".join(variables) if variables else "Explained"


def _constant(variable: str) -> bool:
    return variable.startswith("nothing")


def _effect(effect: JudgedEffect) -> str:
    values = ", ".join(f"{n} = {quantity(e)}" for n, e in effect.parameters.items())
    return f"{effect.name.replace('_', ' ')} at {effect.location} ({values})"


def quantity(estimate: Estimate) -> str:
    """Return value ± 95 % half-width with its unit."""
    return with_interval(estimate.value, estimate.half, typeset(estimate.unit))


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
    """Return the equation whose error fell most, relative to its noise."""
    floor: Mapping[str, float] = result.noise_floor
    return max(result.before, key=lambda e: result.before[e] / max(floor.get(e, 1e-30), 1e-30))


def _errors(result: Trace) -> str:
    if not result.before:
        return ""
    e = equation_of_largest_reduction(result)
    unit = unit_of_equation(result.model_before.rig, e)
    before, after, floor = (
        plain(error.get(e, float("nan")), 2)
        for error in (result.before, result.after, result.noise_floor)
    )
    return f"Held-out error of {e}: {before} → {after} {unit}, noise floor {floor}."
