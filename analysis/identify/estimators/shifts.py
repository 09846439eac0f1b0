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

from analysis.identify.estimators.covariance import CovarianceParts
from analysis.identify.estimators.equations import EquationFit, FamilyBlocks
from analysis.identify.estimators.instruments import Hausman
from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import Solution, half_width

Array = NDArray[np.float64]


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
    half = half_width(np.sqrt(np.diag(error.covariance)), error.dof)[:count]
    return np.where(np.abs(shift) > IDENTIFY.shift_of_interval * half, shift, 0.0)


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
    reference: Mapping[str, tuple[Array, CovarianceParts, EquationFit]],
) -> list[Shift]:
    """Return the shift of every parameter; `reference` is least squares, by family."""
    shifts = []
    for p in prepared:
        test, (_, error, _) = tests[p.family], reference[p.family]
        half = half_width(np.sqrt(np.diag(error.covariance)), error.dof)
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
                    bool(test.certain[i]),
                )
            )
    return shifts


def significant_shift(test: Hausman, p: FamilyBlocks) -> Array:
    """Return least squares minus instruments (k,) of the parameters, 0 where insignificant."""
    return np.where(test.certain, test.difference, 0.0)[: p.parameters]


def predicted_shift(solution: Solution, p: FamilyBlocks) -> Array:
    """Return the bias (k,) of the parameters that the stated sensor noise predicts.

    It stands for the shift against instruments where no repeats give any.
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
