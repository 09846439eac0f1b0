"""Notes on a trace's evidence: few data, masked rows, parameters that the records leave open."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final

import numpy as np

from analysis.effects.base import Effect
from analysis.effects.free_flows import BulkModulusCurve
from analysis.effects.free_forces import FrictionCurve, PositionForce
from analysis.simulation.model import Model
from analysis.terms.base import Used, equation
from analysis.trace.data.noise_floor import (
    ABOVE,
    NEIGHBOURS,
    OTHER_STEPS,
    PERIODS,
    STATED,
    UNSTATED,
)
from analysis.trace.data.regression_data import RegressionData, signals_of
from analysis.trace.data.trace_rows import WHY_MASKED
from analysis.trace.finding import Remainder
from analysis.trace.judge.held_out import refitted_names
from analysis.trace.result import JudgedEffect
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.search.geometry import Geometry
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.settings import TRACE
from rig.model.channels import place_in_words
from rig.model.records import Run, bandwidth_of
from rig.model.rig import Rig
from rig.model.units import plain

MOST_NUMBERS: Final = 3  # of a rig file, in a note
# Begins what a note says of a torque whose rests are not judged; the sentence refers to it.
WITHOUT_RESTS: Final = "judged without the samples at which the joint rests"
OIL_WORDS: Final = {"Fv": "viscous friction", "b": "bulk modulus"}


def evidence_notes(train_data: RegressionData, holdout_data: RegressionData) -> list[str]:
    """State the source of noise floors without repeats, and the rows that are left out."""
    out = []

    def steps(source: str, *data: RegressionData) -> str:
        return " ".join(sorted({f.group[1] for d in data for f in d.floors if f.source == source}))

    if single := steps(STATED, train_data):
        out.append(
            f"one repeat of {single} and no whole periods to compare: the noise floor is "
            "the rig file's stated sensor noise; noise above that value would be taken "
            "for model error, so the evidence for every name is weaker"
        )
    if single := steps(ABOVE, train_data):
        out.append(
            f"one repeat of {single} and no whole periods to compare: the noise floor is what the "
            f"octave above the rows' frequencies holds, {_largest_noise(train_data)}; a repeat "
            "would measure it"
        )
    if steps(UNSTATED, train_data):
        out.append(
            f"nothing repeats, and what the model leaves, up to {_largest_noise(train_data)}, "
            "follows no variable of the records: it counts as noise; repeat a record to measure "
            "the noise"
        )
    for where in (PERIODS, NEIGHBOURS):
        if single := steps(where, train_data):
            out.append(
                f"one repeat of {single}: the noise floor comes from {where} within the record"
            )
    if all(f.source == STATED for f in holdout_data.floors):
        out.append("the held-out noise floor is the rig file's stated sensor noise")
    if scaled := steps(OTHER_STEPS, train_data, holdout_data):
        out.append(
            f"one repeat of {scaled}: the noise floor is the rig file's stated sensor "
            "noise times the ratio that other steps show"
        )
    return [
        *out,
        *_short_step_notes(train_data),
        *masked_row_notes("training", train_data),
        *masked_row_notes("held-out", holdout_data),
    ]


def _largest_noise(data: RegressionData) -> str:
    """Return in words the largest ratio of a noise floor to the stated noise, and its equation."""
    most = max(data.floors, key=lambda f: f.noise / f.stated)
    return f"{plain(most.noise / most.stated, 2)} times the stated sensor noise in {most.equation}"


def _short_step_notes(train_data: RegressionData) -> list[str]:
    """Name the equations of a step that are left out, since it leaves too few of their rows."""
    kept = {(s.group, s.equation) for s in train_data.segments}
    return [
        f"{equation}: step {group[1]!r} is left out of training, since fewer than "
        f"{TRACE.least_rows} rows are usable: its records are short, or {WHY_MASKED}"
        for group, equation in sorted({(f.group, f.equation) for f in train_data.floors} - kept)
    ]


def masked_row_notes(kind: str, data: RegressionData) -> list[str]:
    """Name the equations of which at least `TRACE.masked_share` of the rows is left out."""
    counts: dict[str, int] = {}
    missing: dict[str, int] = {}
    for s in data.segments:
        _, rows = data.source(s)
        counts[s.equation] = counts.get(s.equation, 0) + len(rows.rhs)
        missing[s.equation] = missing.get(s.equation, 0) + rows.masked
    shares = {e: missing[e] / max(missing[e] + counts[e], 1) for e in sorted(counts)}
    return [
        f"{equation}: {plain(100 * share, 2)} % of the {kind} rows are left out, since "
        f"{WHY_MASKED}: an effect that acts only there is not seen"
        for equation, share in shares.items()
        if share >= TRACE.masked_share
    ]


def undetermined_notes(
    model: Model, before: Model | None = None, in_motion: Collection[int] = ()
) -> list[str]:
    """Name the parameters that the records do not determine.

    Where effects were added to a model `before`, those that it lacks too are left out; the free run
    takes the others from it (`held_out.completed`). `in_motion` are the joints (0-based) whose
    torque rows are weighted by speed.
    """
    undetermined = [n for n, e in model.parameters.items() if not e.identified]
    known = {} if before is None else before.parameters
    missing = [n for n in undetermined if n not in known or known[n].identified]
    if not missing:
        return []
    where = f", with {', '.join(equation('torque', i) for i in in_motion)} judged in motion alone,"
    taken = [n for n in missing if n in known]
    return [
        f"the records{where if in_motion else ''} do not determine {', '.join(missing)} (see "
        "`bramah identify`): the share of the motion that belongs to it may show as a residual"
        + (f"; the free run takes {', '.join(taken)} from the model before" if taken else "")
    ]


def record_condition_notes(train_data: RegressionData, winner: Hypothesis) -> list[str]:
    """State sizes at the conditions of the records, for parameters given at other conditions."""
    terms = [(u.term, u.shape) for u in winner.effects if isinstance(u.term, Effect)]
    if not terms:
        return []
    signals = signals_of(train_data)
    remarks = [(term.name, term.remark(train_data.rig, signals, shape)) for term, shape in terms]
    return [f"{name}: {text}" for name, text in remarks if text]


def unseen_load_notes(train: Sequence[Run], unseen: Sequence[Run]) -> list[str]:
    """Name the steps of unseen records with a stated load where no training record has one.

    A load that every training record has is in the arm's own parameters, one that none has in none.
    """
    if any(record.loaded for run in train for record in run.records):
        return []
    steps = dict.fromkeys(r.step for run in unseen for r in run.records if r.loaded)
    if not steps:
        return []
    return [
        f"{' '.join(steps)}: these held-out records carry a load (`loaded`) that no training "
        "record carries, so that its weight and inertia are not in the model: train on loaded "
        "records too, or hold out unloaded ones"
    ]


def refitted_notes(
    fit: ExactFit, judged: ExactFit, model: Model, oil: Mapping[str, float]
) -> list[str]:
    """Name the parameters whose values in the stated errors were fitted to the judging rows.

    `oil` are the relative changes by an oil of another temperature (`held_out.oil_changes`).
    """
    notes = []
    changes = {name.rstrip("0123456789"): change for name, change in oil.items()}
    if "b" in changes:  # the rows hold 1/b
        changes["b"] = 1.0 / (1.0 + changes["b"]) - 1.0
    parts = [
        f"{OIL_WORDS[name]} {plain(100 * abs(change), 2)} % {'larger' if change > 0 else 'smaller'}"
        for name, change in changes.items()
    ]
    if parts:
        lubricant = "a lubricant" if model.rig.electric else "oil"
        notes.append(
            f"the held-out records have {' and '.join(parts)} than the training records, as with "
            f"{lubricant} of another temperature: the errors are given with that; hold out records "
            "as warm as the training records"
        )
    names = [n for n in refitted_names(fit, judged, oil) if n in model.parameters]
    if names:
        times = plain(TRACE.information_ratio**0.5, 1)
        notes.append(
            f"the held-out records show {', '.join(names)} at least {times} times more exactly "
            "than the training records do: the errors are given with their values; record training "
            "motions like the held-out ones"
        )
    return notes


def exact_geometry_notes(rig: Rig, named: Sequence[JudgedEffect]) -> list[str]:
    """State that a wrong number of the rig file may look like a sensor's error, without tolerances.

    A pin 2 mm from where the file has it looked like a piston sensor's offset of 1.9 mm.
    """
    errors = [e for e in named if e.mechanism in ("sensor", "chamber_volume")]
    if rig.electric or rig.uncertain_numbers or not errors:
        return []
    names = ", ".join(f"{e.name} at {place_in_words(e.at)}" for e in errors)
    return [
        f"{names}: areas, volumes and pin distances of the rig file are taken as exact, and a "
        "wrong one may look like this; state `tolerances` there to have that tried"
    ]


def geometry_note(geometry: Geometry, named: Sequence[JudgedEffect], explained: bool) -> str:
    """State the numbers that deviate most from the rig file's, and the answer with the latter."""
    numbers, deviations = geometry.rig.uncertain_numbers, geometry.deviations
    moved = ", ".join(
        f"{numbers[j].name} {abs(deviations[j]):.1f} times {numbers[j].stated} "
        f"{'larger' if deviations[j] > 0.0 else 'smaller'}"
        for j in np.argsort(-np.abs(deviations))[:MOST_NUMBERS]
    )
    effects = ", ".join(f"{e.name} at {place_in_words(e.at)}" for e in named) or "no effect"
    answer = f"{effects} would be named" if explained else "the records would be unexplained"
    return (
        "areas, volumes and pin distances are taken within the tolerances of the rig file, the "
        f"furthest {moved}; as stated, {answer}"
    )


def narrower_rows_note(narrower: float, width: float) -> str:
    """State the bandwidths [Hz] with and without which the effects are named."""
    return (
        f"the effects are named with rows for a motion up to {plain(narrower, 2)} Hz; in those for "
        f"the whole motion, up to {plain(width, 2)} Hz, which they explain to within the noise, "
        "noise of the accelerations hides them or their difference from others"
    )


def slow_residual_note(equation: str, ratio: float, narrower: float) -> str:
    """State what an equation keeps in rows up to a lower bandwidth [Hz], in noise floors."""
    return (
        f"{equation}: in rows for a motion up to {plain(narrower, 2)} Hz, {plain(ratio, 2)} times "
        "the noise floor remains, and no effect explains it there: something slow is not named"
    )


def quicker_motion_notes(train: Sequence[Run], unseen: Sequence[Run]) -> list[str]:
    """Say where held-out motion is quicker than the training's, for which rows are filtered."""
    fitted, held_out = bandwidth_of(train), bandwidth_of(unseen)
    if fitted is None or held_out is None or held_out < TRACE.quicker_motion * fitted:
        return []
    return [
        f"the held-out motion reaches {plain(held_out, 2)} Hz, the training's "
        f"{plain(fitted, 2)} Hz: rows are filtered for the training's, and what is quicker is not "
        "judged; train on motion as quick to judge it"
    ]


def wider_rows_note(width: float) -> str:
    """State that a torque lies above the frequencies of the rows for a bandwidth [Hz]."""
    return (
        f"the motion is below {plain(width, 2)} Hz, and the model is that of rows for it; the "
        "errors are of wider rows, which show a torque at a higher frequency"
    )


def not_judged_notes(
    remaining: Sequence[Remainder], noise: Mapping[str, float], after: Mapping[str, float]
) -> list[str]:
    """State the remainders with a veto that the judging rows do not show.

    `noise` and `after` are noise floor and error of the judging rows, by equation.
    """
    words: dict[str, list[str]] = {}
    for r in remaining:
        if r.veto and after[r.equation] <= TRACE.noted_ratio * noise[r.equation]:
            words.setdefault(r.equation, []).append(r.words)
    return [
        f"{equation}: {', '.join(parts)}; the rows that judge hold noise alone, so that the cause "
        "does not act in all parts of the records"
        for equation, parts in words.items()
    ]


def rival_notes(named: Sequence[JudgedEffect]) -> list[str]:
    """State for each effect the parameter that its tied rivals change most."""
    out = []
    for effect in named:
        changed = [(*r.moved, r) for r in effect.rivals if r.moved]
        if not changed:
            continue
        parameter, change, rival = max(changed, key=lambda entry: abs(entry[1]))
        size = f"be {plain(100 * abs(change), 2)} % {'larger' if change > 0 else 'smaller'}"
        if abs(change) >= 1.0:
            size = "hardly be determined"
        out.append(
            f"with {rival.name} at {rival.location} in place of {effect.name}, {parameter} would "
            f"{size}: its interval is wider for it"
        )
    return out


def shared_parameters(winner: Hypothesis, after: Model) -> dict[str, tuple[Used, str]]:
    """Return the baseline parameters that free curves share: curve and reason, by name.

    Their value depends on how the curve is centred.
    """
    out = {}
    for used in winner.effects:
        effect = used.term
        if isinstance(effect, PositionForce):
            name, what = f"W{effect.joint + 1}", "weight"
            why = "in one pose of the other joints gravity is a force over position too"
        elif isinstance(effect, FrictionCurve) and not after.rig.electric:
            name, what = f"Fv{effect.joint + 1}", "viscous friction"
            why = "where the lever arm hardly changes it is a slope of friction over speed too"
        elif isinstance(effect, BulkModulusCurve):
            name, what = "b", "bulk modulus of oil without air"
            why = "only its sum with the curve at the pressures of the records is determined"
        else:
            continue
        if name in after.parameters:
            shared = (
                f"{effect.name} at {effect.where} shares it; its interval includes the whole curve"
            )
            out[name] = used, f"{name} is no measured {what}: {why}, and {shared}"
    return out
