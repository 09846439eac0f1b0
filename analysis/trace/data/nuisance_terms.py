"""Known physics beside the baseline, fitted but never named: oil temperature, spool paths.

Oil warms from record to record, and its bulk modulus falls with it. On records that measure the
temperature this is one column (`analysis.identify.estimators.nuisance.BulkTemperature`) with
no shape to search. Without it every long experiment leaves a repeatable residual, and effects in
the same equations would not reach the noise floor.

The rows take the spool for linear between its samples. Under a held command a first-order spool of
time constant tau runs along an exponential there, which in the flows acts as a lead of dt^2/(12
tau): one column a joint, C T du/dt sqrt(dp) (`analysis.identify.estimators.nuisance.SpoolPath`).
Without it a quick spool resembles a sensor delay of some tens of microseconds. The current
of an electric drive does the same to its joint's torque (`DrivePath`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.base import BETWEEN_SAMPLES
from analysis.identify.estimators.nuisance import KAPPA, BulkTemperature, sample_paths
from analysis.identify.settings import IDENTIFY
from analysis.simulation.model import Estimate, Model
from analysis.terms import baseline_of
from analysis.terms.base import Used, joint_of
from analysis.trace.data.conditioned_record import model_rows
from analysis.trace.data.regression_data import RegressionData, least_squares
from analysis.trace.settings import DATA
from rig.model import channels as ch
from rig.model.records import Run
from rig.model.rig import Rig


def base_terms(rig: Rig, runs: Sequence[Run]) -> tuple[Used, ...]:
    """Return the rig's baseline terms, with the temperature term where the records need it."""
    terms = tuple(map(Used, baseline_of(rig)))
    return (*terms, *temperature_terms(terms, runs))


def temperature_terms(
    terms: Sequence[Used], runs: Sequence[Run], holdout: Sequence[Run] = ()
) -> tuple[Used, ...]:
    """Return the temperature term to add to `terms`, none where the temperature hardly changes.

    The span over `runs` and `holdout` must reach `DATA.temperature_span`. The parameter b is then
    that at the mean temperature of `runs`, which these records determine best.
    """
    if "compressibility" not in {used.term.name for used in terms}:
        return ()
    train, holdout_data = (_temperatures(x) for x in (runs, holdout))
    # A record without measured temperature makes the span NaN: then no term is added either.
    if not train or not np.ptp([*train, *holdout_data]) >= DATA.temperature_span:
        return ()
    return (Used(BulkTemperature(reference=float(np.mean(train)))),)


def _temperatures(runs: Sequence[Run]) -> list[float]:
    """Return each record's mean oil temperature [degC], NaN where it was not measured."""
    return [
        float(np.nanmean(np.asarray(r.channels[ch.TEMPERATURE])))
        if ch.TEMPERATURE in r.channels
        else np.nan
        for run in runs
        for r in run.records
    ]


def within_plausible_slope(kappa: float, beta: Mapping[str, float]) -> float:
    """Return the change of 1/b with temperature [1/(Pa K)], limited to values of oil and hoses."""
    size = abs(beta.get("b", 0.0))  # of the rows: 1/b
    low, high = (
        -(IDENTIFY.bulk_slope + sign * IDENTIFY.implausible_deviations * IDENTIFY.bulk_slope_std)
        * size
        for sign in (1.0, -1.0)
    )
    return float(np.clip(kappa, low, high))


def at_nominal_temperature(model: Model) -> Model:
    """Return the model with b at the rig's nominal temperature and without the temperature term."""
    (term,) = [u.term for u in model.terms if isinstance(u.term, BulkTemperature)] or (None,)
    names = list(model.parameters)
    if term is None or KAPPA not in names:
        return model
    b, kappa = names.index("b"), names.index(KAPPA)
    bulk = model.parameters["b"]
    covariance = model.covariance.copy()
    if bulk.identified and term.reference is not None:
        kelvin = model.rig.oil.temperature - term.reference
        bulk, added_variance = _bulk_modulus_at(bulk, model.parameters[KAPPA], kelvin)
        covariance[b, b] += added_variance
    kept_numbers = [k for k in range(len(names)) if k != kappa]
    return replace(
        model,
        terms=tuple(u for u in model.terms if not isinstance(u.term, BulkTemperature)),
        parameters={n: bulk if n == "b" else model.parameters[n] for n in names if n != KAPPA},
        covariance=covariance[np.ix_(kept_numbers, kept_numbers)],
    )


def _bulk_modulus_at(b: Estimate, kappa: Estimate, kelvin: float) -> tuple[Estimate, float]:
    """Return b at a temperature higher by `kelvin` [K], and the increase of its variance [Pa^2].

    1/b(T) = 1/b + kappa (T - T0), with kappa as the mean of the records' value and the prior one
    (`IDENTIFY.bulk_slope`), each weighted by its inverse variance.
    """
    prior_slope, prior_std = -IDENTIFY.bulk_slope / b.value, IDENTIFY.bulk_slope_std / b.value
    measured_std = kappa.std if math.isfinite(kappa.std) else math.inf
    weight = prior_std**2 / (prior_std**2 + measured_std**2) if math.isfinite(kappa.value) else 0.0
    slope = weight * kappa.value + (1.0 - weight) * prior_slope if weight else prior_slope
    value = b.value / (1.0 + b.value * slope * kelvin)
    added_variance = (value**2 * kelvin * prior_std) ** 2 * (1.0 - weight)
    std = math.hypot(b.std, math.sqrt(added_variance))
    half = b.half * (std / b.std if b.std > 0 else 1.0)
    return replace(b, value=value, std=std, ci95=(value - half, value + half)), added_variance


def path_terms(data: RegressionData) -> tuple[Used, ...]:
    """Return the path terms to add to the data's own: one for each joint that moves.

    A path whose fitted lead exceeds `BETWEEN_SAMPLES` of a sample is left out: another delay acts.
    """
    rig, kind = data.rig, "torque" if data.rig.electric else "flow"
    moving_equations = [s.equation for s in data.segments if s.equation.startswith(kind)]
    joints = sorted({joint_of(equation) for equation in moving_equations})
    paths = sample_paths(rig, joints, {name: float(v) for name, v in data.beta.items()})
    if not paths:
        return ()
    rows = [model_rows(rig, (*data.terms, *paths), record) for record in data.records]
    lead = least_squares(rig, rows)

    def in_range(used: Used) -> bool:
        (coefficient,) = used.term.coefficients(rig)
        return abs(lead.get(coefficient.parameter, np.inf)) <= BETWEEN_SAMPLES

    return tuple(filter(in_range, paths))
