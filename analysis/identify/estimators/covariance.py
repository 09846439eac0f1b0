"""Covariance of an estimate: scatter between repeats, plus significant lack of fit.

Repeats show noise and other differences between them, but not a model error that is the same in
every repeat. That error appears in the scores g = Z'w e of groups of rows, summed over repeats: for
an exact model they differ from zero by noise only, whose size is known from the repeats. Groups are
the parts of the excitation's period, and the levels of the state that an equation's law depends on.
For either grouping, with u = A^-1 g,
 V_groups = sum u u',  V_noise = sum over groups of n/(n-1) sum_r (u_r - mean)(u_r - mean)',
and where V_groups exceeds V_noise by an F test, the difference is added to the scatter between
repeats as a systematic component: V = V_repeats + max(V_groups - V_noise). It is the square of a
misfit, not an average over many, and counts as known (GUM, type B): it has no part in Student's t.
Sources: stratified cluster covariance as in `analysis.regression.solve`; the idea of grouping in
more than one way is Cameron, Gelbach and Miller's (2011); jackknife CR3 for one repeat only,
MacKinnon, Nielsen and Webb (2023), section 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from analysis.identify.estimators.equations import Pieces
from analysis.identify.settings import IDENTIFY
from analysis.regression.least_squares import scaled_inverse
from analysis.regression.solve import half_width, satterthwaite, stratified

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CovarianceParts:
    """A covariance (k, k), degrees of freedom (k,), the systematic share of each variance (k,)."""

    covariance: Array
    dof: Array
    systematic: Array

    @property
    def half(self) -> Array:
        """The half widths (k,) of the 95 % intervals."""
        return half_width(np.sqrt(np.diag(self.covariance)), self.dof)

    @property
    def normal(self) -> Array:
        """The covariance (k, k) of the normal distribution with the same 95 % intervals.

        The scatter of two repeats may be far too small by chance; its interval is not.
        """
        ones = np.ones(len(self.dof))
        scale = half_width(ones, self.dof) / half_width(ones, np.full_like(self.dof, np.inf))
        return np.asarray(self.covariance * np.outer(scale, scale))


def spread(groupings: Sequence[Pieces], inverse: Array) -> CovarianceParts:
    """Return V_repeats plus lack of fit (k, k); the first grouping is by parts of the period.

    Where a step has only one repeat, the parts of the period take the place of repeats.
    """
    repeats = by_repeats(groupings[0], inverse)
    if repeats is None:
        return by_parts(groupings[0], inverse)
    misfit = [lack_of_fit(pieces, inverse) for pieces in groupings]
    worst = np.max([np.diag(m) for m in misfit], axis=0)
    total = repeats.covariance + np.sum(misfit, axis=0)
    scatter = np.diag(repeats.covariance)
    variance = scatter + worst
    scale = np.sqrt(variance / np.maximum(np.diag(total), 1e-300))
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = np.where(scatter > 0, repeats.dof * (variance / scatter) ** 2, 1.0)
        share = np.where(variance > 0, worst / variance, 0.0)
    return CovarianceParts(total * np.outer(scale, scale), dof, share)


def by_repeats(pieces: Pieces, inverse: Array) -> CovarianceParts | None:
    """Return the scatter between repeats of a step (k, k); None where a step has only one."""
    stratum, score = pieces.grouped(pieces.repeat, pieces.score)
    sandwich = stratified(score @ inverse.T, stratum)
    return None if sandwich is None else CovarianceParts(*sandwich, np.zeros(len(inverse)))


def lack_of_fit(pieces: Pieces, inverse: Array) -> Array:
    """Return max(V_groups - V_noise, 0) (k, k); zero for parameters without significance."""
    _, score = pieces.grouped(pieces.part, pieces.score)
    u = score @ inverse.T
    noise = stratified(pieces.score @ inverse.T, pieces.stratum, pieces.part)
    k = len(inverse)
    if noise is None:
        return np.zeros((k, k))
    scatter = u.T @ u
    size, floor = np.diag(scatter), np.diag(noise[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = np.where(size > 0, size**2 / np.sum(u**4, axis=0), 1.0)
        p = fdtrc(np.maximum(dof, 1.0), np.maximum(noise[1], 1.0), size / floor)
    excess_energy = np.where(p < IDENTIFY.lack_of_fit_level, np.maximum(size - floor, 0.0), 0.0)
    scale = np.sqrt(excess_energy / np.where(size > 0, size, 1.0))
    return np.asarray(scatter * np.outer(scale, scale))


def by_parts(pieces: Pieces, inverse: Array) -> CovarianceParts:
    """Return the jackknife covariance (k, k) over parts of the period, summed over repeats.

    A direction that the rows do not determine, zero in `inverse` (k, k), gets no variance.
    """
    assert pieces.information is not None, "`pieces` has it where a step has one repeat"
    stratum, score = pieces.grouped(pieces.part, pieces.score)
    _, information = pieces.grouped(pieces.part, pieces.information)
    A = scaled_inverse(inverse)
    changes = np.array(
        [_without(A, inverse, part, g) for part, g in zip(information, score, strict=True)]
    )
    k = len(A)
    total, squares = np.zeros((k, k)), np.zeros(k)
    for s in np.unique(stratum):
        u = changes[stratum == s]
        n = len(u)
        part = u.T @ u * ((n - 1) / n if n > 1 else 1.0)
        total += part
        squares += np.diag(part) ** 2 / max(n - 1, 1)
    return CovarianceParts(total, satterthwaite(np.diag(total), squares), np.zeros(k))


def _without(A: Array, inverse: Array, part: Array, score: Array) -> Array:
    """Return the change of beta when a part is left out: (A - A_c)^-1 g_c."""
    size = np.sqrt(np.abs(np.diag(A)))
    scale = np.where(size > 0.0, size, 1.0)
    # A parameter in no row has a score of zero and does not change.
    reduced = (A - part) / np.outer(scale, scale) + np.diag(np.where(size > 0.0, 0.0, 1.0))
    if np.linalg.cond(reduced) > 1e10:
        # A direction that this part alone determines, or that none does: first-order influence.
        return np.asarray(inverse @ score)
    return np.asarray(np.linalg.solve(reduced, score / scale) / scale)
