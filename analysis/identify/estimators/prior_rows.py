"""Prior knowledge of nuisances as further rows of the estimating equations.

A prior observation 0 = h'beta with standard deviation s is one more row with the weight 1 / s^2,
where the other rows have the weight 1 / sigma^2: A becomes A + rho h h', rho = sigma^2 / s^2, and
beta and A^-1 follow by the formula of Sherman and Morrison. sigma^2 is the variance that the rows'
residuals have for h, V = sigma^2 A^-1 in its direction: residuals of neighbouring rows correlate,
so that their mean square would be too small. The same rows belong to least squares and to
instruments: what only a prior determines, such as the slope over a temperature that hardly varied,
would otherwise be left to the noise there. Source: Theil and Goldberger (1961), On Pure and Mixed
Statistical Estimation in Economics, International Economic Review 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.estimators.covariance import CovarianceParts, spread
from analysis.identify.estimators.equations import EquationFit, pieces
from analysis.identify.estimators.nuisance import Prior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PriorRow:
    """A prior observation 0 = h'beta, h (k,), its standard deviation and its weight rho."""

    h: Array
    std: float
    weight: float


def prior_rows(fit: EquationFit, priors: Sequence[Prior]) -> tuple[PriorRow, ...]:
    """Return the rows of prior observations beside those of a fit of least squares.

    A prior has no row where the columns that it concerns are zero in all rows of the fit.
    """
    rows: list[PriorRow] = []
    for prior in priors:
        joined = with_prior_rows(fit, rows)
        share = float(prior.h @ joined.inverse @ prior.h)
        if share > 0.0:
            variance = prior.h @ spread_with_priors(joined, rows).covariance @ prior.h
            rows.append(PriorRow(prior.h, prior.std, float(variance) / share / prior.std**2))
    return tuple(rows)


def with_prior_rows(fit: EquationFit, rows: Sequence[PriorRow]) -> EquationFit:
    """Return the solution (k,) and A^-1 (k, k) of a fit's rows and prior rows together."""
    beta, inverse = fit.beta, fit.inverse
    for row in rows:
        if row.weight > 0.0:
            gain = inverse @ row.h / (1.0 / row.weight + row.h @ inverse @ row.h)
            beta = beta - gain * (row.h @ beta)
            inverse = inverse - np.outer(gain, row.h @ inverse)
    return replace(fit, beta=beta, inverse=inverse)


def spread_with_priors(fit: EquationFit, rows: Sequence[PriorRow]) -> CovarianceParts:
    """Return the spread of a fit joined with prior rows: that of its rows and of the priors.

    Prior knowledge needs no repeats: its part of a variance counts as known.
    """
    own = spread([pieces(fit), pieces(fit, "level")], fit.inverse)
    influence = [row.weight * row.std * (fit.inverse @ row.h) for row in rows]
    known = sum((np.outer(u, u) for u in influence), np.zeros_like(own.covariance))
    scatter = np.diag(own.covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        grown = np.where(scatter > 0, np.minimum(1.0 + np.diag(known) / scatter, 1e3), 1.0)
    systematic = np.minimum(own.systematic, 1.0) / grown
    return CovarianceParts(own.covariance + known, own.dof * grown**2, systematic)
