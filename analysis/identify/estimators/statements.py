"""Checks with figures that describe an estimator's result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.estimators import nuisance as nu
from analysis.identify.estimators.covariance import CovarianceParts
from analysis.identify.estimators.equations import EquationFit
from analysis.identify.estimators.robust import outlying
from analysis.identify.estimators.shifts import Shift, shift_limit
from analysis.identify.settings import IDENTIFY

Array = NDArray[np.float64]

NOISE_CHECK = "noise in regressors"


def nuisance_statement(
    prior: nu.Prior,
    names: Sequence[str],
    beta: Array,
    error: CovarianceParts,
    moved: tuple[str, float] | None,
) -> Check:
    """State the estimate of a nuisance, and whether it is physically possible.

    `moved` of an impossible one is the parameter that moves most without it, and how much
    (relative); the check is ok if that is too little to matter.
    """
    check = _possible(prior, names, beta, error, moved is not None)
    if moved is None or moved[1] > shift_limit(moved[0]):
        return check
    size = f"{100 * moved[1]:.2g} %"
    least = f"no parameter moves by more than {size} without it, which the intervals include"
    if not moved[1]:
        share = IDENTIFY.shift_of_interval
        least = f"no parameter moves by more than {share:g} of its 95 % interval's half width"
    return Check(check.name, True, f"{check.detail} ({least})")


def _possible(
    prior: nu.Prior, names: Sequence[str], beta: Array, error: CovarianceParts, wrong: bool
) -> Check:
    i = list(names).index(prior.name)
    value, std = float(beta[i]), float(np.sqrt(error.covariance[i, i]))
    if prior.name == nu.KAPPA:
        compliance = float(beta[list(names).index("b")])
        alpha, spread_ = -100 * value / compliance, 100 * std / abs(compliance)
        statement = f"b changes by {alpha:.2f} +- {2 * spread_:.2f} % per kelvin by these records"
        if spread_ > 100 * IDENTIFY.bulk_slope_std:
            statement = (
                "the oil's temperature hardly varied: its effect on b is taken as "
                f"{100 * IDENTIFY.bulk_slope:.1f} +- {200 * IDENTIFY.bulk_slope_std:.1f} % per "
                "kelvin"
            )
        if wrong:
            statement += ", which no oil does: b is that of the records' mean temperature"
        else:
            statement += "; b is that of the rig's nominal oil temperature"
        return Check("oil temperature", not wrong, statement)
    if prior.name.startswith((nu.BETWEEN, nu.DRIVE_BETWEEN)):
        statement = (
            f"{value:+.3f} +- {2 * std:.3f} of a sample's interval from the interpolated one"
        )
        if wrong:
            statement += (
                ", more than a command held between samples makes (a lag, a delay?): left out"
            )
        return Check(prior.name, not wrong, statement)
    size = np.sqrt(max(value, 0.0) + 2 * std)
    statement = f"laminar below a drop of {size / 1e6:.2g} MPa at most by these records"
    if wrong:
        statement = (
            "the flow depends on the pressure drop in a way no orifice does (a supply, tank or "
            "sensor pressure that is off, a leak?); the gains are those of the plain square root"
        )
    return Check("laminar transition", not wrong, statement)


def noise_statement(shifts: Sequence[Shift]) -> Check:
    """State whether noise in the regressors biases least squares, and how much (Hausman's test).

    The check is not ok if a shift is significant and matters; the figures are stated for any other.
    """
    if not shifts:
        return Check(NOISE_CHECK, False, "nothing identified to judge")
    certain = [s for s in shifts if s.significant]
    biased = [s for s in certain if s.material]
    if biased:
        worst = max(biased, key=lambda s: abs(s.relative))
        return Check(
            NOISE_CHECK, False,
            f"least squares is biased by noise in the regressors, {_figures(worst)}; so are "
            f"{len(biased) - 1} others; --estimator auto or iv is not",
        )  # fmt: skip
    if certain:
        worst = max(certain, key=lambda s: s.t)
        return Check(
            NOISE_CHECK, True,
            f"noise in the regressors moves least squares, but too little to matter: most "
            f"certainly {_figures(worst)}; {_bounds(worst)}; the intervals include it",
        )  # fmt: skip
    worst = max(shifts, key=lambda s: abs(s.relative))
    chance = (
        ", which would matter but may be chance: more repeats would show it"
        if worst.material
        else ""
    )
    return Check(
        NOISE_CHECK, True,
        f"least squares and instruments from the other repeats agree within their scatter: "
        f"largest difference {_figures(worst)}{chance}",
    )  # fmt: skip


def _figures(s: Shift) -> str:
    return (
        f"{s.name} by {100 * s.relative:+.2g} % against instruments from the other repeats "
        f"({s.t:.2g} of its standard errors, {s.of_half_width:.2g} of the 95 % interval's half "
        "width)"
    )


def _bounds(s: Shift) -> str:
    return (
        f"it would matter beyond {100 * s.limit:g} %, or beyond {IDENTIFY.shift_of_interval:g} of "
        f"the half width and {100 * IDENTIFY.shift_least * s.limit:g} %"
    )


def outlier_statement(family: str, fit: EquationFit) -> Check:
    """State the share of rows that the robust loss left out, in the worst record."""
    shares = outlying(fit)
    record, share = max(shares.items(), key=lambda item: item[1])
    return Check(
        f"outliers {family}",
        share < IDENTIFY.few_outliers,
        f"{100 * share:.2g} % of the rows of record {record!r} lie far outside the scatter and "
        "were left out (the worst record)",
    )
