"""The trace's result in plain words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.simulation.model import Estimate
from analysis.trace.clues.formula import surest
from analysis.trace.result import CLEAN, CONFOUNDED, EXPLAINED, JudgedEffect, Trace
from rig.model.rig import Rig

UNITS = {"torque": "N·m", "flow_cap": "m³/s", "flow_rod": "m³/s"}


def unit_of_equation(rig: Rig, equation: str) -> str:
    """Return the unit of an equation's residual; the torque row of a sliding joint is a force."""
    kind = equation.rsplit("_", 1)[0]
    if kind == "torque" and getattr(rig, "prismatic", False):
        return "N"
    return UNITS.get(kind, "")


def sentence(result: Trace) -> str:
    """Return one paragraph that a person can act on."""
    if result.verdict == CLEAN:
        return (
            "Nothing stands above the noise: the baseline model explains these records, and there "
            "is nothing to name."
        )
    named = "; ".join(_effect(e) for e in result.effects)
    errors = _errors(result)
    if result.verdict == EXPLAINED:
        return f"{_moves(result.effects)}: {named}. {errors}"
    if result.verdict == CONFOUNDED:
        rivals = ", ".join(f"{name} at {where}" for name, where in result.tied)
        text = f"Best is {named}, but these records cannot tell it from {rivals}."
        if result.next_experiment:
            text += f" What would tell: {result.next_experiment['text']}."
        return f"{text} {errors}"
    prefix = f"Found so far: {named}. " if named else "No effect of the catalogue is named. "
    clue = ", ".join(d.text for d in result.depends_on[:2])
    return (
        f"{prefix}{100 * result.unexplained_fraction:.0f} % of what repeats stays unexplained"
        + (f"; it moves with {clue}" if clue else "")
        + _symmetry(result)
        + _formula(result)
        + (f". {errors}" if named else ".")
    )


def _formula(result: Trace) -> str:
    """Say what a sparse fit reads that leaves next to nothing ('' where none does)."""
    best = surest(result.formulas)
    return f"; a sparse fit reads {best.text}" if best else ""


def _symmetry(result: Trace) -> str:
    """Say what the lines of the loudest remainder show of its cause ('' without such lines)."""
    loud = max(result.lines, key=lambda lines: lines.loud_after, default=None)
    if loud is None or loud.loud_after < 1.0:
        return ""
    return f"; by its lines in {loud.equation} it is {loud.meaning_after}"


def _moves(effects: tuple[JudgedEffect, ...]) -> str:
    variables = [e.variable for e in effects if e.variable and not _constant(e.variable)]
    if len(variables) < len(effects) and variables:
        variables.append("a constant")
    return "The residual follows " + " and ".join(variables) if variables else "Explained"


def _constant(variable: str) -> bool:
    return variable.startswith("nothing")


def _effect(effect: JudgedEffect) -> str:
    values = ", ".join(f"{n} = {quantity(e)}" for n, e in effect.parameters.items())
    return f"{effect.name.replace('_', ' ')} at {effect.where} ({values})"


def quantity(estimate: Estimate) -> str:
    """Return value ± 95 % half-width with its unit."""
    unit = estimate.unit.replace("*", "·").replace("^2", "²").replace("^3", "³")
    half = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
    return f"{estimate.value:.3g} ± {half:.1g} {unit}".strip()


def shot_in_words(effect: JudgedEffect) -> str:
    """Return what multiple shooting makes of an effect's shapes ('' where it has no such state)."""
    if effect.shot is None:
        return ""
    shot = effect.shot
    values = ", ".join(f"{n} = {quantity(e)}" for n, e in shot.shapes.items())
    which = "taken" if shot.taken else "the rows' stay, their interval holds both"
    judged = "no held-out window tells which is closer"
    if np.isfinite([shot.before, shot.after]).all():
        judged = f"held-out windows {shot.before:.2f} → {shot.after:.2f} times the sensors' noise"
    return f"by multiple shooting {values}; {judged}: {which}"


def loudest(result: Trace) -> str:
    """Return the equation whose error fell most, relative to its noise."""
    floor: Mapping[str, float] = result.noise_floor
    return max(result.before, key=lambda e: result.before[e] / max(floor.get(e, 1e-30), 1e-30))


def _errors(result: Trace) -> str:
    if not result.before:
        return ""
    e = loudest(result)
    unit = unit_of_equation(result.model_before.rig, e)
    return (
        f"Held-out error of {e}: {result.before[e]:.2g} → {result.after.get(e, float('nan')):.2g} "
        f"{unit}, noise floor {result.noise_floor.get(e, float('nan')):.2g}."
    )
