"""Errors on hold-out records, and the energy that effects remove or add there."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from analysis.identify.estimators.nuisance import KAPPA
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows
from analysis.simulation.model import Model
from analysis.simulation.validate import RecordValidation, validate
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import effects_among
from analysis.trace.data.conditioned_record import model_rows, row_residual
from analysis.trace.data.noise_floor import Floor, Group, floors
from analysis.trace.data.nuisance_terms import within_plausible_slope
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.set_aside import in_judging_block
from analysis.trace.judge.curves import within_knots
from analysis.trace.result import FreeCurves
from analysis.trace.search.exact_fit import DesignMatrix, ExactFit, design_matrix
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE
from analysis.workers.pool import Pool
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
    like an error of the model. Before that, the oil of another day is allowed for (`oil_changes`).
    No coefficient of an effect is changed.
    """
    return _refitted(holdout_data.rig, design_matrix(holdout_data, model.terms), model)


def _refitted(rig: Rig, rows: DesignMatrix, model: ExactFit) -> ExactFit:
    """Return `refitted_to_held_out` by the design matrix of the held-out rows."""
    model = _with_fitted_temperature(rows, model)
    changes = _oil_changes(rig, rows, model)
    model = replace(model, beta={n: v * (1.0 + changes.get(n, 0.0)) for n, v in model.beta.items()})
    fixed = {c.parameter for e in effects_among(model.terms) for c in e.coefficients(rig)} | {KAPPA}
    # A coefficient that no row contains would be moved by rounding alone.
    visible = np.sum(rows.matrix**2, axis=0) + np.diag(model.information) > 0.0
    numbers = [k for k, n in enumerate(rows.names) if visible[k] and n not in fixed]
    X, training = rows.matrix[:, numbers], model.information[np.ix_(numbers, numbers)]
    held_out = X.T @ X
    scale = np.sqrt(np.diag(held_out) + np.diag(training))
    least, unit = TRACE.eigenvalue_ratio * np.eye(len(numbers)), np.outer(scale, scale)
    ratio, directions = eigh(held_out / unit, training / unit + least)
    better_known = directions[:, ratio > TRACE.information_ratio] / scale[:, None]
    if not better_known.shape[1]:  # the usual case
        return model
    residual = rows.residual(model.beta)
    step = better_known @ np.linalg.lstsq(X @ better_known, residual, rcond=None)[0]
    changed = {rows.names[k]: float(v) for k, v in zip(numbers, step, strict=True)}
    return replace(model, beta={n: v + changed.get(n, 0.0) for n, v in model.beta.items()})


def oil_changes(holdout_data: RegressionData, model: ExactFit) -> dict[str, float]:
    """Return the relative changes of viscous friction and 1/b that held-out rows need, by name.

    Oil of another temperature has another viscosity and bulk modulus: one factor for the viscous
    friction of all joints, and one for 1/b, each within `TRACE.viscosity_change` and
    `TRACE.bulk_change`. A factor counts only where it exceeds `TRACE.standard_errors` of its noise
    and leaves at most `TRACE.noted_ratio` times the noise: otherwise it would hide a part of an
    effect that the model lacks.
    """
    return _oil_changes(holdout_data.rig, design_matrix(holdout_data, model.terms), model)


def _oil_changes(rig: Rig, rows: DesignMatrix, model: ExactFit) -> dict[str, float]:
    """Return `oil_changes` by the design matrix of the held-out rows."""
    viscous = (t for t in baseline_of(rig) if t.name == "viscous_friction")
    friction = [c.parameter for term in viscous for c in term.coefficients(rig)]
    changes: dict[str, float] = {}
    for names, bound in ((friction, TRACE.viscosity_change), (["b"], TRACE.bulk_change)):
        beta = {n: v for n, v in model.beta.items() if n in names and n in rows.names}
        column = rows.matrix[:, [rows.names.index(n) for n in beta]] @ list(beta.values())
        size = float(np.linalg.norm(column))
        if not size > 0.0:
            continue
        acting, residual = column != 0.0, rows.residual(model.beta)
        change = float(np.clip(column @ residual / size**2, -bound, bound))
        left = (residual - change * column)[acting]
        noise_alone = left @ left <= TRACE.noted_ratio**2 * len(left)
        if abs(change) > TRACE.standard_errors / size and noise_alone:
            changes |= dict.fromkeys(beta, change)
    return changes


def refitted_names(
    before: ExactFit, after: ExactFit, oil: Mapping[str, float] = MappingProxyType({})
) -> list[str]:
    """Return the coefficients that `refitted_to_held_out` changed by more than `noted_shift`.

    The changes `oil` (`oil_changes`) do not count.
    """
    return [
        name
        for name, value in before.beta.items()
        if name != KAPPA
        and abs(after.beta[name] - value * (1.0 + oil.get(name, 0.0)))
        > TRACE.noted_shift * abs(value)
    ]


def _with_fitted_temperature(rows: DesignMatrix, model: ExactFit) -> ExactFit:
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
    floor_rows: list[dict[str, Rows]] = []
    parts: tuple[list[tuple[str, Rows]], list[tuple[str, Rows]]] = ([], [])  # before, after
    groups: list[Group] = []
    for c in members:
        with_lines = replace(c, filtering=replace(c.filtering, lines=()))
        after_rows = model_rows(rig, after.terms, c)
        judging = [model_rows(rig, before.terms, with_lines), after_rows]
        if c.group in divided:
            judging = [
                {e: r.at(in_judging_block(r.time)) for e, r in rows.items()} for rows in judging
            ]
        floor_rows.append(judging[1] if repeats[c.group] > 1 else after_rows)
        groups += [c.group] * len(after_rows)
        for part, rows in zip(parts, judging, strict=True):
            for e, r in rows.items():
                part.append((e, r.at(within_knots(rig, (curves or {}).get(e, ()), c, r))))
    split = floors(rig, after.terms, members, floor_rows, after.beta, others, noise_ratio)
    floor = {(f.group, f.equation): f.noise for f in split}
    noise: dict[str, list[float]] = {}
    counts: dict[str, list[int]] = {}
    for group, (e, r) in zip(groups, parts[1], strict=True):
        noise.setdefault(e, []).append(floor[group, e])
        counts.setdefault(e, []).append(max(len(r.rhs), 1))
    return Errors(
        {
            e: float(np.sqrt(np.average(np.square(floors_of), weights=counts[e])))
            for e, floors_of in sorted(noise.items())
        },
        _rms_by_equation((e, r.rhs) for e, r in parts[0]),
        *(
            _rms_by_equation((e, row_residual(r, model.beta)) for e, r in part)
            for part, model in zip(parts, (before, after), strict=True)
        ),
    )


def rms_of(holdout_data: RegressionData, model: ExactFit) -> dict[str, float]:
    """Return the rms of every equation's held-out residual, SI, repeats averaged."""
    residual = held_out_residual(holdout_data, model)
    return _rms_by_equation(
        (s.equation, residual[s.where] * s.noise / np.sqrt(s.repeats))
        for s in holdout_data.segments
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
    run, other = before.first, after.first
    if run is None or other is None or run.record != other.record:
        return None
    count = min(round(TRACE.curve_seconds / float(run.time[1] - run.time[0])), len(run.time))
    shown = slice(0, count, max(count // TRACE.curve_points, 1))
    measured, simulated, simulated_after = (
        {name: channels[name][shown] for name in run.measured}
        for channels in (run.measured, run.simulation.channels(), other.simulation.channels())
    )
    return FreeCurves(run.record, run.time[shown], run.units, measured, simulated, simulated_after)


def free_runs(
    holdout: Sequence[Run], before: Model, after: Model, pool: Pool
) -> tuple[FreeRunErrors, FreeRunErrors]:
    """Return the free runs of both models, driven by the measured spool or drive alone."""
    models = [before] if after is before else [before, after]
    runs = list(pool.map(lambda model: _free_runs(holdout, model), models))
    return runs[0], runs[-1]


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
        error_after = after.window_rmse.get(channel, 0.0)  # none: a parameter is not identified
        if math.isfinite(error) and not error_after <= TRACE.free_run_ratio * error:
            if not math.isfinite(error_after):
                return f"the held-out free run of {channel} fails with it, and not without"
            times = error_after / error
            return f"the held-out free run of {channel} is {times:.2g} times worse with it"
    return ""


def _free_runs(holdout: Sequence[Run], model: Model) -> FreeRunErrors:
    try:
        results = validate(model, holdout)
    except InputError:  # a parameter that is not identified: there is no simulation
        return FreeRunErrors({}, {}, {})
    fit, rmse, windows = {}, {}, {}
    for c in sorted({channel for r in results for channel in r.fit}):
        of_channel = [r for r in results if c in r.fit]
        weight = np.array([math.nan if r.failure else 1.0 for r in of_channel])
        fit[c] = float(np.mean(weight * [r.fit[c] for r in of_channel]))
        rmse[c] = float(np.sqrt(np.mean(weight * [r.rmse[c] ** 2 for r in of_channel])))
        windows[c] = float(np.sqrt(np.mean([r.window_rmse[c] ** 2 for r in of_channel])))
    return FreeRunErrors(fit, rmse, windows, next((r for r in results if not r.failure), None))


def removed_energy(winner: Hypothesis, alternative: Hypothesis) -> dict[str, float]:
    """Return the training energy that an effect removes, by equation in which it acts."""
    removed = {
        e: alternative.excess_energy[e] - winner.excess_energy[e] for e in alternative.excess_energy
    }
    most = max(removed.values())
    return {e: v for e, v in removed.items() if v > SEARCH.acting_share * most}


def disturbed_equations(
    hypotheses: HypothesisSet, winner: Hypothesis, alternative: Hypothesis
) -> list[str]:
    """Return the equations in which an effect leaves more energy than the baseline.

    It must be more by what noise may add (`TRACE.harm_deviations`) and by `TRACE.harm_ratio`, more
    than without the effect, and more than `TRACE.harm_share` of what the set removes elsewhere.
    """
    before = {e: max(0.0, v) for e, v in hypotheses.empty.excess_energy.items()}
    removed = sum(max(0.0, v - winner.excess_energy[e]) for e, v in before.items())

    def allowed(equation: str) -> float:
        noise = math.sqrt(2.0 * hypotheses.train_data.row_counts[equation])
        least = max(TRACE.harm_deviations * noise, TRACE.harm_share * removed)
        return before[equation] + min(hypotheses.noise_band[equation], least)

    return [
        e
        for e, energy in winner.excess_energy.items()
        if energy > max(allowed(e), TRACE.harm_ratio * before[e], alternative.excess_energy[e])
    ]


def disturbed_in_held_out(
    holdout_data: RegressionData, before: Array, without: Array, after: Array
) -> list[str]:
    """Return the equations whose held-out error an effect increases.

    Their error exceeds `TRACE.noted_ratio` noise floors, and their energy above noise exceeds that
    of the baseline by `TRACE.harm_ratio` and that without the effect. `before`, `without` and
    `after` (M,) are the whitened residuals of the baseline, and without and with the effect.
    """
    energies = [energy_above_noise(holdout_data, r) for r in (before, without, after)]
    baseline, without_effect, with_effect = energies
    return [
        e
        for e, ratio in error_over_floor(holdout_data, after).items()
        if ratio > TRACE.noted_ratio
        and with_effect[e] > max(TRACE.harm_ratio * max(0.0, baseline[e]), without_effect[e])
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
    """Return the share of the held-out energy above noise that an effect removes.

    It is the mean over equations, weighted by the training energy that the effect removes in each
    (`changes`): an error of the baseline in another equation does not count against the effect.
    `without` and `after` (M,) are the whitened residuals without and with the effect. In an
    equation without energy above noise the share is that of the effect's change which the residual
    shows; equations where that change is within the noise are left out.
    """
    energy, remaining = (energy_above_noise(holdout_data, r) for r in (without, after))
    shares, in_noise = {}, True
    for e in changes:  # in their order: a set's would change the sum's last digit
        if e not in energy:
            continue
        residual = _residual_of(holdout_data, without, (e,))
        change = residual - _residual_of(holdout_data, after, (e,))
        size = float(np.linalg.norm(change))
        if energy[e] > TRACE.standard_errors * np.sqrt(2.0 * len(residual)):
            in_noise = False
            shares[e] = max(-1.0, 1.0 - max(0.0, remaining[e]) / energy[e])
        elif size > 2.0 * TRACE.standard_errors:
            # 1 on average if the effect is right, 0 if there is none, with a deviation of 1 / size.
            shares[e] = float(np.clip(residual @ change / size**2, -1.0, 1.0))
    total = sum(changes[e] for e in shares)
    share = sum(changes[e] * v for e, v in shares.items()) / total if total > 0.0 else 0.0
    return Removal(share, bool(shares) and in_noise)


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
