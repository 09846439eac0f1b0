"""Bias of least squares by noise in the regressors: its significance and its size.

With enough data any shift becomes significant, even one of 1e-5, so that its size is judged as
well. Only a shift that is both significant and large makes another estimator preferable. A
significant shift that is too small to matter stays in the value and is added to the interval (GUM
F.2.4.5: a known systematic effect that is not corrected is part of the uncertainty).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.estimators import nuisance as nu
from analysis.identify.estimators.covariance import CovarianceParts
from analysis.identify.estimators.equations import EquationFit, FamilyBlocks
from analysis.identify.estimators.instruments import Hausman
from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import Solution

Array = NDArray[np.float64]

NOISE_CHECK = "noise in regressors"


def shift_limit(name: str) -> float:
    """Return the relative shift of a parameter beyond which it always matters."""
    return IDENTIFY.shift_limit_of_b if name == "b" else IDENTIFY.shift_limit


@dataclass(frozen=True)
class Shift:
    """The difference of one parameter between least squares and instrumental variables.

    `relative` is signed, of the parameter itself; `t` its size in its own standard errors;
    `of_half_width` its size over the half width of the 95 % interval without it.
    """

    name: str
    relative: float
    t: float
    of_half_width: float
    significant: bool

    @property
    def limit(self) -> float:
        """The relative shift beyond which it always matters."""
        return shift_limit(self.name)

    @property
    def material(self) -> bool:
        """Return whether it is large enough to matter if it is significant."""
        size = abs(self.relative)
        return size > self.limit or (
            self.of_half_width > IDENTIFY.shift_of_interval
            and size > IDENTIFY.shift_least * self.limit
        )


def shift_without(value: Array, without: Array, error: CovarianceParts, count: int) -> Array:
    """Return how much the first `count` coefficients shift when a nuisance is left out.

    `value` (m,) are the coefficients with it and `error` their spread, `without` those without it.
    A shift within `IDENTIFY.shift_of_interval` of the 95 % half width counts as 0.
    """
    shift = without[:count] - value[:count]
    least = IDENTIFY.shift_of_interval * error.half[:count]
    return np.where(np.abs(shift) > least, shift, 0.0)


def largest_shift(names: Sequence[str], value: Array, shift: Array) -> tuple[str, float]:
    """Return the parameter of largest relative `shift` (k,) from `value` (k,), and its size.

    Shifts are compared by the limits beyond which they matter.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(shift == 0.0, 0.0, np.abs(shift / value))
    worst = int(np.argmax(relative / [shift_limit(name) for name in names]))
    return names[worst], float(relative[worst])


def shifts_of(
    prepared: Sequence[FamilyBlocks],
    tests: Mapping[str, Hausman],
    errors: Mapping[str, CovarianceParts],
) -> list[Shift]:
    """Return the shift of every parameter; `errors` are those of least squares, by family."""
    shifts = []
    for p in prepared:
        test, error = tests[p.family], errors[p.family]
        half = error.half
        for i, name in enumerate(p.names[: p.parameters]):
            size = abs(float(test.difference[i]))
            # The rows contain 1/b: a larger 1/b is a smaller b.
            sign = -1.0 if name == "b" else 1.0
            shifts.append(
                Shift(
                    name,
                    sign * float(test.relative[i]),
                    size / float(test.error[i]) if test.error[i] > 0 else 0.0,
                    size / float(half[i]) if half[i] > 0 else np.inf,
                    bool(test.significant[i]),
                )
            )
    return shifts


def significant_shift(test: Hausman, p: FamilyBlocks) -> Array:
    """Return least squares minus instruments (k,) of the parameters, 0 where insignificant."""
    return np.where(test.significant, test.difference, 0.0)[: p.parameters]


def predicted_shift(solution: Solution, p: FamilyBlocks) -> Array:
    """Return the bias (k,) of the parameters that the stated sensor noise predicts.

    It replaces the shift against instruments where there are no repeats.
    """
    bias = dict(zip(solution.names, solution.noise_bias, strict=True))
    predicted: Array = np.array([bias[name] for name in p.names[: p.parameters]])
    return np.where(np.isfinite(predicted), predicted, 0.0)


def including(error: CovarianceParts, shift: Array) -> CovarianceParts:
    """Return the spread (k,) of least squares with every significant shift as a systematic part."""
    before = np.diag(error.covariance)
    after = before + shift**2
    with np.errstate(divide="ignore", invalid="ignore"):
        grown = np.where(before > 0, after / before, 1.0)
        share = np.where(after > 0, (error.systematic * before + shift**2) / after, 0.0)
    return CovarianceParts(error.covariance + np.outer(shift, shift), error.dof * grown**2, share)


def nuisance_statement(
    prior: nu.Prior,
    names: Sequence[str],
    fit: EquationFit,
    error: CovarianceParts,
    moved: tuple[str, float] | None,
) -> Check:
    """State the estimate of a nuisance, and whether it is physically possible.

    `moved` of an impossible one is the parameter that moves most without it, and how much
    (relative); the check is ok if that is too little to matter.
    """
    check = _prior_check(prior, names, fit, error, moved is not None)
    if moved is None or moved[1] > shift_limit(moved[0]):
        return check
    size = f"{100 * moved[1]:.2g} %"
    note = f"no parameter moves by more than {size} without it, which the intervals include"
    if not moved[1]:
        share = IDENTIFY.shift_of_interval
        note = f"no parameter moves by more than {share:g} of its 95 % interval's half width"
    return Check(check.name, True, f"{check.detail} ({note})")


def _prior_check(
    prior: nu.Prior,
    names: Sequence[str],
    fit: EquationFit,
    error: CovarianceParts,
    implausible: bool,
) -> Check:
    i = list(names).index(prior.name)
    value = float(fit.beta[i])
    std = np.sqrt(nu.variance_by_rows(fit, error, np.eye(len(names))[i]))
    if prior.name == nu.KAPPA:
        compliance = float(fit.beta[list(names).index("b")])
        alpha, spread_ = -100 * value / compliance, 100 * std / abs(compliance)
        statement = f"b changes by {alpha:.2f} +- {2 * spread_:.2f} % per kelvin by these records"
        if spread_ > 100 * IDENTIFY.bulk_slope_std:
            statement = (
                "the oil's temperature hardly varied: its effect on b is taken as "
                f"{100 * IDENTIFY.bulk_slope:.1f} +- {200 * IDENTIFY.bulk_slope_std:.1f} % per "
                "kelvin"
            )
        if implausible:
            statement += ", which no oil does: b is that of the records' mean temperature"
        else:
            statement += "; b is that of the rig's nominal oil temperature"
        return Check("oil temperature", not implausible, statement)
    if prior.name.startswith((nu.BETWEEN, nu.DRIVE_BETWEEN)):
        statement = (
            f"{value:+.3f} +- {2 * std:.3f} of a sample's interval from the interpolated one"
        )
        if implausible:
            statement += (
                ", more than a measured current makes (a lag, a delay? a command that is recorded "
                "in its place and held makes -0.5): left out"
                if prior.name.startswith(nu.DRIVE_BETWEEN)
                else ", more than a command held between samples makes (a lag, a delay?): left out"
            )
        return Check(prior.name, not implausible, statement)
    size = np.sqrt(max(value, 0.0) + 2 * std)
    statement = f"laminar below a drop of {size / 1e6:.2g} MPa at most by these records"
    if implausible:
        statement = (
            "the flow depends on the pressure drop in a way no orifice does (a supply, tank or "
            "sensor pressure that is off, a leak?); the gains are those of the plain square root"
        )
    return Check("laminar transition", not implausible, statement)


def noise_statement(shifts: Sequence[Shift]) -> Check:
    """State whether noise in the regressors biases least squares, and how much (Hausman's test).

    The check is not ok if a shift is significant and matters; the figures are stated for any other.
    """
    if not shifts:
        return Check(NOISE_CHECK, False, "nothing identified to judge")
    significant = [s for s in shifts if s.significant]
    biased = [s for s in significant if s.material]
    if biased:
        worst = max(biased, key=lambda s: abs(s.relative))
        return Check(
            NOISE_CHECK, False,
            f"least squares is biased by noise in the regressors in {len(biased)} of "
            f"{len(shifts)} parameters, most {_figures(worst)}; --estimator auto or iv is not",
        )  # fmt: skip
    if significant:
        worst = max(significant, key=lambda s: s.t)
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
