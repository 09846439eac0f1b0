"""Instrumental variables across synchronised repeats, and the check on noise in the regressors.

Repeats of a step had the same excitation started at the same sample, so the rows of the other
repeats say what a repeat's regressor is without its noise: Z_r = mean of X over the others. Noise
of r is independent of Z_r, and attenuation, the bias of least squares, is gone.
Hausman's idea: both estimates agree unless noise in the regressors biases least squares; whether
their difference is more than its own scatter is tested. Source: Hausman (1978), Econometrica 46;
Soederstroem and Stoica, Instrumental Variable Methods for System Identification (1983).
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
    common,
    least_squares,
    over_repeats,
    pieces,
    shared_ticks,
    solve,
)
from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import stratified

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hausman:
    """Least squares minus instruments (k,), its standard error (k,) and p values (k,)."""

    difference: Array
    error: Array
    p: Array
    relative: Array

    @property
    def certain(self) -> NDArray[np.bool_]:
        """Where (k,) the difference is more than chance."""
        return np.asarray(self.p < IDENTIFY.instrument_level / len(self.p))


def steps_without_instruments(blocks: Sequence[RepeatBlock]) -> set[str]:
    """Return the steps with an equation of which no two repeats share a row.

    A repeat that was cut short may keep none behind the filters' edges.
    """
    repeats = Counter((*b.stratum, b.equation) for b in blocks)
    shared = shared_ticks(blocks)
    return {key[1] for key, n in repeats.items() if n < 2 or not len(shared[key])}


def instrumental_variables(blocks: Sequence[RepeatBlock]) -> EquationFit:
    """Solve with the other repeats' mean rows as instruments; every step needs two repeats."""
    blocks = common(blocks)
    sums = over_repeats(blocks, [b.X for b in blocks])
    Z = [(total - b.X) / (n - 1) for b, (total, n) in zip(blocks, sums, strict=True)]
    return solve(blocks, Z, [np.ones(len(b.y)) for b in blocks])


def hausman(blocks: Sequence[RepeatBlock]) -> Hausman:
    """Compare least squares with instruments on the same rows.

    The difference scatters by noise, which parts of the period show separately: its covariance is
    that between repeats within each part (of which there are many more than repeats).
    """
    iv = instrumental_variables(blocks)
    ls = least_squares(iv.blocks)
    difference = ls.beta - iv.beta
    plain, instrumented = pieces(ls), pieces(iv)
    influence = plain.score @ ls.inverse.T - instrumented.score @ iv.inverse.T
    scatter = stratified(np.column_stack((plain.stratum, plain.part)), influence)
    assert scatter is not None, "instruments exist only where steps have repeats"
    covariance, dof = scatter
    error = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(error > 0, np.abs(difference) / error, 0.0)
        relative = difference / iv.beta
    return Hausman(difference, error, 2 * stdtr(dof, -statistic), relative)
