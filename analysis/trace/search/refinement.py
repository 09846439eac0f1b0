"""Refinement: the exact fit of a set of effects, with shapes by variable projection.

The rows of the averaged records are computed again at every shape, the linear coefficients are
solved for, and only the shapes are searched (Golub and Pereyra, 1973). An effect that rescales the
right side (a sensor's gain) would reduce the residual by the scaling alone: while its shapes are
searched, rows are scaled back to the size of the right side before the change. The residual of the
final fit is of rows without that scaling.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares as minimise

from analysis.effects.base import Effect, Shape, open_shapes, shape_values, shapes_of
from analysis.identify import checks as ck
from analysis.simulation.model import Estimate
from analysis.terms.base import Term, Used
from analysis.trace.data.candidates import at_start, effect_in, fixed_details, shape_grid
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.nuisance_terms import temperature_terms
from analysis.trace.data.regression_data import (
    RegressionData,
    evidence,
    regression_data,
    signals_of,
)
from analysis.trace.search.exact_fit import (
    ExactFit,
    design_matrix,
    fit_coefficients,
    is_logarithmic,
    jacobian,
    over_amplified_noise,
    rescale,
    tangent,
    with_term,
)
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import SEARCH, TRACE
from rig.model.records import Run, with_common_bandwidth
from rig.model.rig import Rig

Array = NDArray[np.float64]


def refine(
    data: RegressionData, terms: Sequence[Used], rival: ExactFit | None = None,
    in_form: Collection[Used] = (),
) -> ExactFit:  # fmt: skip
    """Return the fit with searched shapes of all effects that are not among the data's own terms.

    The search starts from the shapes given. Of the forms of an effect the one that leaves least, at
    a price for each free number, is used. Then details of the form are added that remove more than
    chance (`SEARCH.number_price`) and more than `SEARCH.detail_share` of the remaining energy above
    noise. Terms `in_form` keep the form that they have.

    With a fit `rival` to be replaced, the search ends early where it leaves over
    `SEARCH.unpromising_ratio` times as much and little less than `SEARCH.first_steps` before. Where
    it leaves more than the rival, the terms in both keep their forms.

    Shapes of effects that rescale signals are searched in rows of unchanged size
    (`RegressionData.relative`). The fit returned is of rows over their noise.
    """
    if not rescale(data, terms):
        return _refined(data, terms, rival, in_form)
    relative_fit = _refined(replace(data, relative=True), terms, rival, in_form)
    return fit_coefficients(data, relative_fit.terms)


def _refined(
    data: RegressionData, terms: Sequence[Used], rival: ExactFit | None, in_form: Collection[Used]
) -> ExactFit:
    """Return the fit of `refine` to rows of the size that `data.relative` states."""
    unchanged = [k for k, used in enumerate(terms) if used in data.terms or used in in_form]
    in_rival: Sequence[int] = ()
    rival_energy = math.inf
    if rival is not None:
        in_rival = [k for k, used in enumerate(terms) if used in rival.terms]
        rival_energy = rival.energy
        limit = SEARCH.unpromising_ratio * rival_energy
        start = _with_searched_shapes(data, terms, SEARCH.first_steps)
        terms = start.terms
        if start.energy > limit:
            continued = _with_searched_shapes(data, terms, SEARCH.first_steps)
            if continued.energy > max(limit, SEARCH.promising_drop * start.energy):
                return continued
            terms = continued.terms
    start = _with_searched_shapes(data, terms)

    def in_best_forms(shown_first: bool) -> ExactFit:
        fit = start
        for k in range(len(terms)):
            if k in unchanged or not isinstance(terms[k].term, Effect):
                continue
            if k in in_rival and fit.energy > rival_energy:
                continue
            fit = _with_details(data, _in_best_form(data, fit, k, shown_first), k, shown_first)
        return fit

    fit = in_best_forms(shown_first=False)
    if not _is_shown(data, fit):
        # A smooth level of friction may fit best beside a breakaway that never falls.
        shown = in_best_forms(shown_first=True)
        return shown if _is_shown(data, shown) else fit
    return fit


def _is_shown(data: RegressionData, fit: ExactFit) -> bool:
    """Return whether the records show every effect of a fit (`Effect.not_shown`)."""
    tested = [
        u for u in fit.terms
        if u not in data.terms and isinstance(u.term, Effect)
        and type(u.term).not_shown is not Effect.not_shown
    ]  # fmt: skip
    if not tested:
        return True
    values, signals = fit.parameters(data.rig), signals_of(data)
    return not any(
        effect_in(u).not_shown(data.rig, values, u.shape, fit.terms, signals) for u in tested
    )


def _with_details(data: RegressionData, fit: ExactFit, place: int, shown_first: bool) -> ExactFit:
    """Return the fit with details of the form of term number `place`, where they remove enough."""
    used = fit.terms[place]
    starts = effect_in(used).detailed_shapes(data.rig, used.shape)
    opened = [Used(used.term, start) for start in starts if start != used.shape]
    least_gain = max(SEARCH.number_price, SEARCH.detail_share * (fit.energy - len(fit.residual)))
    # Half, since the linear prediction is less than what a detail removes.
    promising = [
        fit_coefficients(data, with_term(fit.terms, used, start))
        for start in opened
        if _predicted_gain(data, fit, used, start) >= 0.5 * least_gain
    ]
    nearest = sorted(promising, key=lambda model: model.energy)[: SEARCH.detail_starts]
    searched = [_with_searched_shapes(data, model.terms) for model in nearest]
    detailed = min(searched, key=lambda model: model.energy, default=fit)
    if fit.energy - detailed.energy <= least_gain:
        return fit
    # A form that fitted better without the details need not do so with them.
    detailed = _in_best_form(data, detailed, place, shown_first)
    gain = fit.energy - detailed.energy
    # Of a lag, a detail may only make the noise smaller.
    quieter = _energy_over_noise(data, fit) - _energy_over_noise(data, detailed)
    sure = min(gain, quieter) > least_gain and _determines_shapes(
        data, detailed, detailed.terms[place], used
    )
    return detailed if sure and not _replaces_detail(data, fit, detailed, used) else fit


def _energy_over_noise(data: RegressionData, fit: ExactFit) -> float:
    """Return the energy of a fit's residual over the noise that its effects amplify."""
    return float(np.sum(over_amplified_noise(data, fit, fit.residual) ** 2))


def _replaces_detail(data: RegressionData, fit: ExactFit, detailed: ExactFit, used: Used) -> bool:
    """Return whether another effect beside `used` leaves as little as details of its form.

    Over part of its range, a gain and an offset of a sensor resemble a curved characteristic.
    """
    present = {u.term for u in fit.terms}
    others = [
        effect for effect in effect_in(used).alternatives_to_detail() if effect not in present
    ]
    beside = (
        _with_searched_shapes(data, (*fit.terms, at_start(data.rig, effect))) for effect in others
    )
    return any(model.energy <= detailed.energy + SEARCH.number_price for model in beside)


def _determines_shapes(data: RegressionData, fit: ExactFit, used: Used, undetailed: Used) -> bool:
    """Return whether the rows determine an effect's shapes beside the details of its form.

    Each shape that is larger than `undetailed`, without the details, must have a relative standard
    error of at most `SEARCH.shape_error`, and no shape or detail may lie at its bound. Otherwise
    the detail fits something else: noise that reverses a contact at rest resembles a long
    presliding distance that decreases with speed.
    """
    shapes = shapes_of(data.rig, used)
    if any(map(_detail_at_bound, shapes, used.shape)) or effect_in(used).outside(
        data.rig, used.shape
    ):
        return False
    names, columns = tangent(data, fit)
    misfit = math.sqrt(max(1.0, fit.energy / len(fit.residual)))
    undetailed_values = shape_values(data.rig, undetailed)
    for shape, value in zip(shapes, used.shape, strict=True):
        larger = abs(value) > abs(undetailed_values.get(shape.parameter, 0.0))
        if shape.detail or shape.fixed or not shape.is_present(value) or not larger:
            continue
        column = names.index(shape.parameter)
        basis = orthonormal(np.delete(columns, column, axis=1))
        projected = columns[:, column] - basis @ (basis.T @ columns[:, column])
        if misfit > SEARCH.shape_error * abs(value) * float(np.linalg.norm(projected)):
            return False
    return True


def _detail_at_bound(shape: Shape, value: float) -> bool:
    """Return whether a searched detail lies at its high bound, or at a low one below 0."""
    margin = 1e-3 * (shape.high - shape.low)
    low = shape.low + margin if shape.low < 0.0 else -math.inf
    searched = shape.detail and not shape.fixed
    return searched and not shape.saturates and not low <= value <= shape.high - margin


def _in_best_form(data: RegressionData, fit: ExactFit, place: int, shown_first: bool) -> ExactFit:
    """Return the fit with the term number `place` in the form that leaves least.

    Each further free number or fixed detail of a form must be significant
    (`TRACE.standard_errors`): an exponent that is not would widen the interval of the size tenfold.
    A form within its physical bounds is preferred to one at them, and with `shown_first` one with
    which the records show every effect.
    """
    price = TRACE.standard_errors**2

    def priced(model: ExactFit) -> tuple[bool, bool, float]:
        used = model.terms[place]
        hidden = shown_first and not _is_shown(data, model)
        outside = bool(effect_in(used).outside(data.rig, used.shape))
        numbers = len(_free_shapes(data, model.terms)) + fixed_details(data.rig, model.terms)
        return hidden, outside, model.energy + price * numbers

    while True:
        used = fit.terms[place]
        others = [
            model
            for shape in effect_in(used).other_form_starts(data.rig, used.shape)
            if (model := _in_other_form(data, fit, place, shape)) is not None
        ]
        best = min(others, key=priced, default=fit)
        if priced(best) >= priced(fit):
            return fit
        fit = best


def _in_other_form(
    data: RegressionData, fit: ExactFit, place: int, start: tuple[float, ...]
) -> ExactFit | None:
    """Return the fit with the term number `place` in another form, from the shape `start` of it.

    None where the form leaves more than `SEARCH.unpromising_form` times as much beside the other
    terms' shapes as they are.
    """
    used = fit.terms[place]
    terms = with_term(fit.terms, used, Used(used.term, start))
    alone = _with_searched_shapes(data, terms, only=place)
    if alone.energy > SEARCH.unpromising_form * fit.energy:
        return None
    # From the start: the shapes found alone may lie in a local minimum.
    return _with_searched_shapes(data, terms)


def _predicted_gain(data: RegressionData, fit: ExactFit, used: Used, opened: Used) -> float:
    """Return the energy that the details of a term would remove, to first order."""
    column = (
        design_matrix(data, with_term(fit.terms, used, opened)).residual(fit.beta) - fit.residual
    )
    absorbed = np.hstack((design_matrix(data, fit.terms).matrix, jacobian(data, fit, used)[1]))
    basis = orthonormal(absorbed)
    column = column - basis @ (basis.T @ column)
    size = float(column @ column)
    return float(column @ fit.residual) ** 2 / size if size > 0 else 0.0


def _with_searched_shapes(
    data: RegressionData, terms: Sequence[Used], steps: int = SEARCH.steps, only: int | None = None
) -> ExactFit:
    """Return the fit whose searched shapes start at those of the terms, after at most `steps`.

    Those of the term number `only`, if given, are searched alone.
    """
    free = [entry for entry in _free_shapes(data, terms) if only is None or entry[0] == only]
    if not free:
        return fit_coefficients(data, terms)
    terms = _on_better_side(data, terms, free)
    start = np.array([_to_unit(terms[k].shape[j], s) for k, j, s in free])

    def terms_at(x: Array) -> tuple[Used, ...]:
        shapes = [list(u.shape) for u in terms]
        for value, (k, j, s) in zip(x, free, strict=True):
            shapes[k][j] = _from_unit(float(value), s)
        return tuple(
            Used(u.term, u.term.limited_shape(v) if isinstance(u.term, Effect) else tuple(v))
            for u, v in zip(terms, shapes, strict=True)
        )

    # Scaled by the derivatives: a dead band of a thousandth of the spool's range would otherwise
    # take tiny steps beside a shape in the middle of its range.
    search = minimise(
        lambda x: fit_coefficients(data, terms_at(x)).residual, np.clip(start, 1e-6, 1 - 1e-6),
        bounds=(0.0, 1.0), diff_step=1e-3, x_scale="jac", xtol=SEARCH.shape_tolerance,
        ftol=SEARCH.tolerance, gtol=1e-12, max_nfev=steps,
    )  # fmt: skip
    return fit_coefficients(data, terms_at(search.x))


def _free_shapes(data: RegressionData, terms: Sequence[Used]) -> list[tuple[int, int, Shape]]:
    """Return the searched shapes: number of the term, number of the shape in it, shape."""
    return [
        (k, j, s)
        for k, u in enumerate(terms)
        if u not in data.terms
        for j, s in enumerate(shapes_of(data.rig, u))
        if s.is_present(u.shape[j]) and not s.fixed
    ]


def _on_better_side(
    data: RegressionData, terms: Sequence[Used], free: Sequence[tuple[int, int, Shape]]
) -> tuple[Used, ...]:
    """Return the terms with every free shape on the side of its neutral value that leaves less.

    The linear search gives the size, not the sign, and from the wrong side the search of shapes
    runs to the bound instead of through the neutral value.
    """
    terms, least_energy = tuple(terms), np.nan
    for k, j, s in free:
        if s.neutral is None or not s.low < s.neutral < s.high:
            continue
        used = terms[k]
        mirrored = float(np.clip(2 * s.neutral - used.shape[j], s.low, s.high))
        shape = (*used.shape[:j], mirrored, *used.shape[j + 1 :])
        other = (*terms[:k], Used(used.term, shape), *terms[k + 1 :])
        if np.isnan(least_energy):  # fitted only if a shape has two sides, which few have
            least_energy = fit_coefficients(data, terms).energy
        energy = fit_coefficients(data, other).energy
        if energy < least_energy:
            terms, least_energy = other, energy
    return terms


def _to_unit(value: float, shape: Shape) -> float:
    """Return a shape value mapped to 0..1 between its bounds, by logarithm if far apart."""
    if is_logarithmic(shape):
        return float(np.log(value / shape.low) / np.log(shape.high / shape.low))
    return (value - shape.low) / (shape.high - shape.low)


def _from_unit(x: float, shape: Shape) -> float:
    if is_logarithmic(shape):
        return float(shape.low * (shape.high / shape.low) ** x)
    return shape.low + x * (shape.high - shape.low)


def fits_in_other_forms(data: RegressionData, fit: ExactFit) -> list[tuple[Used, ExactFit]]:
    """Return each effect with each fit in which it has another of its forms."""
    out = []
    for used in fit.terms:
        if used in data.terms or not isinstance(used.term, Effect):
            continue
        for shape in used.term.other_form_starts(data.rig, used.shape):
            terms = with_term(fit.terms, used, Used(used.term, shape))
            out.append((used, _with_searched_shapes(data, terms)))
    return out


def at_best_size(data: RegressionData, used: Used, others: Sequence[Used]) -> Used:
    """Return an effect scaled in size by the best of `SEARCH.start_shares`, beside `others`."""
    shapes = shapes_of(data.rig, used)
    if all(s.neutral is None for s in shapes):
        return used

    def scaled(share: float) -> Used:
        return Used(
            used.term,
            tuple(
                value if s.neutral is None else s.neutral + share * (value - s.neutral)
                for s, value in zip(shapes, used.shape, strict=True)
            ),
        )

    return _best_start(data, [scaled(share) for share in SEARCH.start_shares], others)


def _best_start(data: RegressionData, starts: Sequence[Used], others: Sequence[Used]) -> Used:
    """Return the start that leaves least energy in the data's model with the others."""
    return min(starts, key=lambda used: fit_coefficients(data, (*data.terms, *others, used)).energy)


@dataclass(frozen=True)
class ShapeFit:
    """The terms of a model with shapes found in records, and the fit of them to `data`."""

    terms: tuple[Used, ...]
    data: RegressionData
    fit: ExactFit


def fit_shapes(runs: Sequence[Run], terms: Sequence[Used]) -> ShapeFit | None:
    """Fit the missing shapes of a model's terms to the runs' rows; return None if none is missing.

    Effects are added one after another, each from the points of its shape grid that leave least.
    Then each is searched again beside the others until none leaves less: the lag of one joint's
    spool biases b, and with it the lag of another joint's. Shapes that the terms have are kept.
    Raises InputError for unusable records.
    """
    runs = with_common_bandwidth(runs)
    rig = ck.common_rig(runs)
    open_terms = [u for u in terms if open_shapes(rig, u)]
    if not open_terms:
        return None
    other_terms = [u for u in terms if u not in open_terms]
    data = regression_data(
        rig, (*other_terms, *temperature_terms(other_terms, runs)), conditioned_records(rig, runs)
    )
    grid_evidence = evidence(data, data.mean_residual)

    def searched(effect: Term, others: Sequence[Used], place: int) -> ExactFit:
        assert isinstance(effect, Effect)
        trials = [
            (*data.terms, *others[:place], Used(effect, point), *others[place:])
            for point in shape_grid(effect, rig, grid_evidence)
        ]
        # Several starts, since the best point may be one from which no search leads on: a metering
        # edge that no spool reaches has no derivative.
        nearest = sorted(trials, key=lambda trial: fit_coefficients(data, trial).energy)
        starts = nearest[: SEARCH.shape_starts]
        return min((refine(data, trial) for trial in starts), key=lambda fit: fit.energy)

    best = fit_coefficients(data, data.terms)
    for k, used in enumerate(open_terms):
        best = searched(used.term, best.terms[len(data.terms) :], k)
    improved = len(open_terms) > 1
    while improved:
        improved = False
        for k, used in enumerate(open_terms):
            effects = best.terms[len(data.terms) :]
            refit = searched(used.term, (*effects[:k], *effects[k + 1 :]), k)
            if refit.energy < best.energy - SEARCH.number_price:
                best, improved = refit, True
    shaped = dict(zip(open_terms, best.terms[len(data.terms) :], strict=True))
    return ShapeFit(tuple(shaped.get(u, u) for u in terms), data, best)


def shapes_in(rig: Rig, terms: Sequence[Used]) -> dict[str, Estimate]:
    """Return a model's shapes by name, without standard errors and intervals (NaN)."""
    return {
        s.parameter: Estimate(value, s.unit, math.nan, (math.nan, math.nan))
        for u in terms
        for value, s in zip(u.shape, shapes_of(rig, u), strict=True)
        if s.is_present(value)
    }
