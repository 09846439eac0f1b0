"""Errors on records that no model was fitted to, and what effects remove and disturb there."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from analysis.identify.estimators.nuisance import KAPPA
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows
from analysis.simulation.model import Model
from analysis.simulation.validate import RecordValidation, validate
from analysis.terms.base import Used
from analysis.trace.data.candidates import effects_among
from analysis.trace.data.conditioned_record import model_rows, row_residual
from analysis.trace.data.noise_floor import Floor, Group, floors
from analysis.trace.data.nuisance_terms import within_plausible_slope
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import judging_rows
from analysis.trace.judge.curves import rows_within
from analysis.trace.result import FreeCurves
from analysis.trace.search.exact_fit import DesignMatrix, ExactFit, design_matrix
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """RMS of each equation's residual over the held-out records, SI, beside its noise floor.

    `size` is the rms of the equation's right side (torque, force or flow) under the model before.
    """

    noise: Mapping[str, float]
    size: Mapping[str, float]
    before: Mapping[str, float]
    after: Mapping[str, float]


def held_out_residual(holdout_data: RegressionData, model: ExactFit) -> Array:
    """Return the whitened residual (M,) of a model after `refitted_to_held_out`."""
    rows = design_matrix(holdout_data, model.terms)
    return rows.residual(_refitted(holdout_data.rig, rows, model).beta)


def refitted_to_held_out(holdout_data: RegressionData, model: ExactFit) -> ExactFit:
    """Return the model with coefficients fitted to held-out rows that determine them much better.

    They are the temperature part of 1/b (records at one temperature do not determine it, others
    then warm up), and every direction of the baseline's coefficients on which the held-out rows
    have `TRACE.information_ratio` times the information of the training rows: two joints that move
    together show a coupling inertia that joints locked in turn do not, and its error would look
    like an error of the model. No coefficient of an effect is changed.
    """
    return _refitted(holdout_data.rig, design_matrix(holdout_data, model.terms), model)


def _refitted(rig: Rig, rows: DesignMatrix, model: ExactFit) -> ExactFit:
    """Return `refitted_to_held_out` by the design of the held-out rows."""
    model = _at_temperature(rows, model)
    of_effects = {
        c.parameter for effect in effects_among(model.terms) for c in effect.coefficients(rig)
    }  # fmt: skip
    # A coefficient that no row contains would be moved by rounding alone.
    shown = np.sum(rows.matrix**2, axis=0) + np.diag(model.information) > 0.0
    at = [k for k, n in enumerate(rows.names) if shown[k] and n not in {KAPPA, *of_effects}]
    X, known = rows.matrix[:, at], model.information[np.ix_(at, at)]
    seen = X.T @ X
    scale = np.sqrt(np.diag(seen) + np.diag(known))
    least = TRACE.eigenvalue_ratio * np.eye(len(at))
    ratio, directions = eigh(seen / np.outer(scale, scale), known / np.outer(scale, scale) + least)
    free = directions[:, ratio > TRACE.information_ratio] / scale[:, None]
    if not free.shape[1]:  # the usual case
        return model
    step = free @ np.linalg.lstsq(X @ free, rows.residual(model.beta), rcond=None)[0]
    changed = {rows.names[k]: float(v) for k, v in zip(at, step, strict=True)}
    return replace(model, beta={n: v + changed.get(n, 0.0) for n, v in model.beta.items()})


def refitted_names(before: ExactFit, after: ExactFit) -> list[str]:
    """Return the coefficients that `refitted_to_held_out` changed by more than `noted_shift`."""
    return [
        name
        for name, value in before.beta.items()
        if name != KAPPA and abs(after.beta[name] - value) > TRACE.noted_shift * abs(value)
    ]


def _at_temperature(rows: DesignMatrix, model: ExactFit) -> ExactFit:
    if KAPPA not in rows.names:
        return model
    column = rows.matrix[:, rows.names.index(KAPPA)]
    size = float(column @ column)
    step = float(column @ rows.residual(model.beta)) / size if size > 0 else 0.0
    kappa = within_plausible_slope(model.beta.get(KAPPA, 0.0) + step, model.beta)
    return replace(model, beta={**model.beta, KAPPA: kappa})


def errors(
    rig: Rig,
    members: Sequence[ConditionedRecord],
    before: ExactFit,
    after: ExactFit,
    divided: Collection[Group] = (),
    curves: Mapping[str, Sequence[Used]] | None = None,
    others: Sequence[Floor] = (),
    noise_ratio: Mapping[str, float] | None = None,
) -> Errors:
    """Return every equation's error under both models, its size and noise floor, over all records.

    `members` are the records, each repeat by itself; of those in `divided` groups only the judging
    rows count, and only rows within the outermost knots of the equation's `curves`. The noise floor
    is that of the residual under the model `after`. A record without repeats has a floor by its
    periods or neighbouring states, for which all its rows are used, or by `others` or `noise_ratio`
    (`noise_floor.floors`).
    Sines that are taken out of the rows are part of what the model `before` leaves.
    """
    repeats = Counter(c.group for c in members)
    compared: list[dict[str, Rows]] = []
    first: list[tuple[str, Rows]] = []
    other: list[tuple[str, Rows]] = []
    groups: list[Group] = []
    for c in members:
        bare = replace(c, filtering=replace(c.filtering, lines=()))
        whole = model_rows(rig, after.terms, c)
        sides = [model_rows(rig, before.terms, bare), whole]
        if c.group in divided:
            sides = [{e: judging_rows(r) for e, r in rows.items()} for rows in sides]
        compared.append(sides[1] if repeats[c.group] > 1 else whole)
        groups += [c.group] * len(whole)
        for side, rows_of in zip((first, other), sides, strict=True):
            side += [
                (e, rows_within(rig, (curves or {}).get(e, ()), c, r)) for e, r in rows_of.items()
            ]
    split = floors(rig, after.terms, members, compared, after.beta, others, noise_ratio)
    floor = {(f.group, f.equation): f.noise for f in split}
    noise: dict[str, list[float]] = {}
    counts: dict[str, list[int]] = {}
    for group, (e, rows) in zip(groups, other, strict=True):
        noise.setdefault(e, []).append(floor[group, e])
        counts.setdefault(e, []).append(max(len(rows.rhs), 1))
    return Errors(
        {
            e: float(np.sqrt(np.average(np.square(own), weights=counts[e])))
            for e, own in sorted(noise.items())
        },
        _rms_by_equation((e, rows.rhs) for e, rows in first),
        _rms_by_equation((e, row_residual(rows, before.beta)) for e, rows in first),
        _rms_by_equation((e, row_residual(rows, after.beta)) for e, rows in other),
    )


def rms_of(holdout_data: RegressionData, model: ExactFit) -> dict[str, float]:
    """Return the rms of every equation's held-out residual, SI, repeats averaged."""
    rest = held_out_residual(holdout_data, model)
    return _rms_by_equation(
        (s.equation, rest[s.where] * s.noise / np.sqrt(s.repeats)) for s in holdout_data.segments
    )


def _rms_by_equation(parts: Iterable[tuple[str, Array]]) -> dict[str, float]:
    """Return the rms of each equation's values over all its parts, NaN without values."""
    collected: dict[str, list[Array]] = {}
    for equation, part in parts:
        collected.setdefault(equation, []).append(part)
    joined = {e: np.concatenate(own) for e, own in sorted(collected.items())}
    return {e: float(np.sqrt(np.mean(x**2))) if len(x) else math.nan for e, x in joined.items()}


@dataclass(frozen=True)
class FreeRunErrors:
    """Errors of simulations, by channel: mean FIT [%] and RMSE [SI] of free runs over all records.

    `window_rmse` [SI] is of windows restarted from the data. A failed simulation makes a figure
    NaN. `first` is the first record whose free run did not fail.
    """

    fit: Mapping[str, float]
    rmse: Mapping[str, float]
    window_rmse: Mapping[str, float]
    first: RecordValidation | None = None


def free_curves(before: FreeRunErrors, after: FreeRunErrors) -> FreeCurves | None:
    """Return the beginning of one held-out record, measured and under both models; None if none."""
    first, other = before.first, after.first
    if first is None or other is None or first.record != other.record:
        return None
    count = min(round(TRACE.curve_seconds / float(first.time[1] - first.time[0])), len(first.time))
    kept = slice(0, count, max(count // TRACE.curve_points, 1))
    before_it, after_it = first.simulation.channels(), other.simulation.channels()
    return FreeCurves(
        first.record,
        first.time[kept],
        first.units,
        {name: y[kept] for name, y in first.measured.items()},
        {name: before_it[name][kept] for name in first.measured},
        {name: after_it[name][kept] for name in first.measured},
    )


def free_runs(
    holdout: Sequence[Run], before: Model, after: Model
) -> tuple[FreeRunErrors, FreeRunErrors]:
    """Return the free runs of both models, driven by the measured spool or drive alone."""
    first = _free_runs(holdout, before)
    return first, first if after is before else _free_runs(holdout, after)


def completed(after: Model, before: Model) -> Model:
    """Return the model with the values of `before` for parameters that only it determines.

    Without a value of an inertia there would be no free run. Returns `after` itself where it lacks
    none.
    """
    known = {n: e for n, e in before.parameters.items() if e.identified}
    lacking = {n: known[n] for n, e in after.parameters.items() if not e.identified and n in known}
    return replace(after, parameters={**after.parameters, **lacking}) if lacking else after


def worse_free_run(before: FreeRunErrors, after: FreeRunErrors) -> str:
    """Say in which channel effects make the free run far worse ('' if in none).

    Windows restarted from the data are compared: over a whole record a drift grows without bound.
    """
    for channel, error in before.window_rmse.items():
        now = after.window_rmse.get(channel, 0.0)  # none: a parameter is not identified
        if math.isfinite(error) and not now <= TRACE.free_run_ratio * error:
            if not math.isfinite(now):
                return f"the held-out free run of {channel} fails with it, and not without"
            return f"the held-out free run of {channel} is {now / error:.2g} times worse with it"
    return ""


def _free_runs(holdout: Sequence[Run], model: Model) -> FreeRunErrors:
    try:
        results = validate(model, holdout)
    except InputError:  # a parameter that is not identified: there is no simulation
        return FreeRunErrors({}, {}, {})
    fit, rmse, windows = {}, {}, {}
    for c in sorted({channel for r in results for channel in r.fit}):
        own = [r for r in results if c in r.fit]
        lost = np.array([math.nan if r.failure else 1.0 for r in own])
        fit[c] = float(np.mean(lost * [r.fit[c] for r in own]))
        rmse[c] = float(np.sqrt(np.mean(lost * [r.rmse[c] ** 2 for r in own])))
        windows[c] = float(np.sqrt(np.mean([r.window_rmse[c] ** 2 for r in own])))
    return FreeRunErrors(fit, rmse, windows, next((r for r in results if not r.failure), None))


def removed_energy(winner: Hypothesis, alternative: Hypothesis) -> dict[str, float]:
    """Return the training energy that an effect removes, by equation in which it acts."""
    change = {
        e: alternative.excess_energy[e] - winner.excess_energy[e] for e in alternative.excess_energy
    }
    most = max(change.values())
    return {e: v for e, v in change.items() if v > SEARCH.acting_share * most}


def disturbed_equations(
    hypotheses: HypothesisSet, winner: Hypothesis, alternative: Hypothesis
) -> list[str]:
    """Return the equations in which an effect leaves more energy than the baseline.

    It must be more by the noise's band and by `TRACE.harm_ratio`, and more than without the effect.
    """
    before = {e: max(0.0, v) for e, v in hypotheses.empty.excess_energy.items()}
    return [
        e
        for e, now in winner.excess_energy.items()
        if now > before[e] + hypotheses.noise_band.by_equation[e]
        and now > TRACE.harm_ratio * before[e]
        and now > alternative.excess_energy[e]
    ]


def disturbed_in_held_out(
    holdout_data: RegressionData, before: Array, without: Array, after: Array
) -> list[str]:
    """Return the equations in which held-out records lose by an effect.

    Their error exceeds `TRACE.noted_ratio` noise floors, and their energy above noise exceeds that
    of the baseline by `TRACE.harm_ratio` and that without the effect. `before`, `without` and
    `after` (M,) are the whitened residuals of the baseline, and without and with the effect.
    """
    start, alone, now = (energy_above_noise(holdout_data, r) for r in (before, without, after))
    return [
        e
        for e, ratio in error_over_floor(holdout_data, after).items()
        if ratio > TRACE.noted_ratio
        and now[e] > max(TRACE.harm_ratio * max(0.0, start[e]), alone[e])
    ]


class Removal(NamedTuple):
    """The share of held-out energy that an effect removes; `in_noise`: noise hides that energy."""

    share: float
    in_noise: bool


def removal_in_words(removed: Removal, disturbed: Collection[str]) -> str:
    """Say which share of the energy an effect removes, and the equations that it disturbs."""
    text = f"{100 * removed.share:.0f} % of the energy above noise"
    if removed.in_noise:
        text = f"{100 * removed.share:.0f} % of what it would change, less than the noise"
    if not disturbed:
        return text
    equations = " ".join(sorted(disturbed))
    return f"{text}, but the residual of {equations} is larger than under the baseline"


def removal_of(
    holdout_data: RegressionData, changes: Mapping[str, float], without: Array, after: Array
) -> Removal:
    """Return what an effect removes of the held-out energy above noise.

    It is the mean over equations, weighted by the training energy that the effect removes in each
    (`changes`): an error of the baseline in another equation does not count against the effect.
    Where the held-out rows of an equation (`without` and with the effect, `after`: (M,), whitened)
    have no more energy than noise, the share is that of the effect's change which they show;
    equations where that change would not show are left out.
    """
    before, now = energy_above_noise(holdout_data, without), energy_above_noise(holdout_data, after)
    shares, above = {}, set()
    for equation in changes:  # in their order: a set's would change the sum's last digit
        if equation not in before:
            continue
        start = _residual_of(holdout_data, without, (equation,))
        change = start - _residual_of(holdout_data, after, (equation,))
        size = float(np.linalg.norm(change))
        if before[equation] > TRACE.standard_errors * np.sqrt(2.0 * len(start)):
            above.add(equation)
            shares[equation] = max(-1.0, 1.0 - max(0.0, now[equation]) / before[equation])
        elif size > 2.0 * TRACE.standard_errors:
            # 1 on average if the effect is right, 0 if there is none; the noise makes it 1 / size.
            shares[equation] = float(np.clip(start @ change / size**2, -1.0, 1.0))
    total = sum(changes[e] for e in shares)
    share = sum(changes[e] * v for e, v in shares.items()) / total if total > 0.0 else 0.0
    return Removal(share, bool(shares) and not above)


def rms_in(data: RegressionData, residual: Array, equations: Collection[str]) -> float:
    """Return the rms of whitened residuals (M,) in some equations; NaN where they have no rows."""
    part = _residual_of(data, residual, equations)
    return float(np.sqrt(np.mean(part**2))) if len(part) else float("nan")


def _residual_of(data: RegressionData, residual: Array, equations: Collection[str]) -> Array:
    """Return the part (m,) of a residual (M,) in some equations."""
    parts = [residual[s.where] for s in data.segments if s.equation in equations]
    return np.concatenate(parts) if parts else np.zeros(0)


def error_over_floor(holdout_data: RegressionData, residual: Array) -> dict[str, float]:
    """Return the held-out error of single records over the noise floor, by equation."""
    floor: dict[str, float] = {}
    energy: dict[str, float] = {}
    for s in holdout_data.segments:
        count = (s.where.stop - s.where.start) * s.repeats
        floor[s.equation] = floor.get(s.equation, 0.0) + count * s.noise**2
        # The average has less noise than a record: the difference is added.
        part = residual[s.where]
        record_energy = float(part @ part) + count * (1 - 1 / s.repeats)
        energy[s.equation] = energy.get(s.equation, 0.0) + record_energy * s.noise**2
    return {e: float(np.sqrt(energy[e] / floor[e])) for e in floor}
