"""Instrumental variables across synchronised repeats, and the check on noise in the regressors.

Repeats of a step had the same excitation started at the same sample, so the mean of the other
repeats' rows is a repeat's regressor without its own noise: Z_r = mean of X over the others. Noise
of r is independent of Z_r, which removes attenuation, the bias of least squares. Hausman's idea:
both estimates agree unless noise in the regressors biases least squares; the test compares their
difference with its own scatter. Source: Hausman (1978), Econometrica 46; Soederstroem and Stoica,
Instrumental Variable Methods for System Identification (1983).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from analysis.identify.estimators.equations import (
    EquationFit,
    RepeatBlock,
    over_repeats,
    pieces,
    shared_ticks,
    solve,
    with_common_rows,
)
from analysis.identify.estimators.nuisance import PriorRow, with_prior_rows
from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import stratified

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hausman:
    """Least squares minus instruments (k,), its standard error, p value and relative size (k,)."""

    difference: Array
    error: Array
    p: Array
    relative: Array

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Where (k,) the difference is significant, all parameters tested together."""
        return np.asarray(self.p < IDENTIFY.instrument_level / len(self.p))


def steps_without_instruments(blocks: Sequence[RepeatBlock]) -> set[str]:
    """Return the steps with an equation of which no two repeats share a row.

    A repeat that was cut short may have no rows outside the filters' edges.
    """
    repeats = Counter(b.shared for b in blocks)
    shared = shared_ticks(blocks)
    return {key[1] for key, n in repeats.items() if n < 2 or not len(shared[key])}


def instrumental_variables(blocks: Sequence[RepeatBlock]) -> EquationFit:
    """Solve with the other repeats' mean rows as instruments; every step needs two repeats."""
    blocks = with_common_rows(blocks)
    sums = over_repeats(blocks, [b.X for b in blocks])
    Z = [(total - b.X) / (n - 1) for b, (total, n) in zip(blocks, sums, strict=True)]
    return solve(blocks, Z, [np.ones(len(b.y)) for b in blocks])


def hausman(plain: EquationFit, rows: Sequence[PriorRow] = ()) -> Hausman:
    """Compare least squares, `plain` on rows that all repeats have, with instrumental variables.

    Both have the same prior rows. The difference scatters by noise: its covariance is that between
    repeats within each part of the period, of which there are many more than repeats.
    """
    iv = with_prior_rows(instrumental_variables(plain.blocks), rows)
    ls = with_prior_rows(plain, rows)
    difference = ls.beta - iv.beta
    of_ls, of_iv = pieces(ls), pieces(iv)
    influence = of_ls.score @ ls.inverse.T - of_iv.score @ iv.inverse.T
    scatter = stratified(influence, of_ls.stratum, of_ls.part)
    assert scatter is not None, "instruments exist only where steps have repeats"
    covariance, dof = scatter
    error = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(error > 0, np.abs(difference) / error, 0.0)
        relative = difference / iv.beta
    return Hausman(difference, error, 2 * stdtr(dof, -statistic), relative)
