"""Nonlinear least squares on reduced rows: linear unknowns as functions of fewer parameters.

Rows y = X x with x = h(p). Gauss and Newton's step from p0 is least squares of y - X c on X J,
J = dh/dp at p0 and c = h(p0) - J p0; both follow from the triangle of [X y] by

    [X J, y - X c] = [X y] S,   S = [[J, -c], [0, 1]],

so the rows are not needed again, and covariance, noise bias and identifiability are those of
`analysis.regression.solve` at the solution (the delta method). Source: Bjorck, Numerical Methods
for Least Squares Problems, section 9.2.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.regression.settings import REGRESSION
from analysis.regression.solve import RowCluster, Solution, merge, solve
from analysis.terms.base import ParameterReduction, Used
from rig.model.rig import Rig

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


def reduced(
    rig: Rig,
    terms: Sequence[Used],
    linear: Solution,
    clusters: Sequence[RowCluster],
    noise: Array | None = None,
    reject_noise: bool = True,
) -> Solution:
    """Return the solution in the terms' parameters; `linear` itself where no term reduces."""
    solution = linear
    for used in terms:
        reduction = used.term.reduction(rig)
        if reduction is not None and set(reduction.linear) <= set(solution.names):
            solution, clusters, noise = _reduce(reduction, solution, clusters, noise, reject_noise)
    return solution


@dataclass(frozen=True)
class Linearisation:
    """Linear unknowns x = slope p + constant of rows near a solution.

    `names` (m,) are those of p; `slope` (k, m) and `constant` (k,).
    """

    names: tuple[str, ...]
    slope: Array
    constant: Array

    @property
    def is_identity(self) -> bool:
        """Whether every parameter is an unknown of the rows itself."""
        return np.array_equal(self.slope, np.eye(len(self.slope)))

    def at(self, p: Array) -> Array:
        """Return the unknowns x (k,) at the parameters p (m,)."""
        return self.constant + self.slope @ p


def linearised(
    rig: Rig, terms: Sequence[Used], names: Sequence[str], values: Mapping[str, float]
) -> Linearisation:
    """Return the unknowns `names` (k,) of rows as linear functions of the terms' parameters.

    `values` are the parameters at which the functions are linearised, by name. Where no term
    reduces, p = x.
    """
    out = Linearisation(tuple(names), np.eye(len(names)), np.zeros(len(names)))
    for used in terms:
        reduction = used.term.reduction(rig)
        if reduction is None or not set(reduction.linear) <= set(out.names):
            continue
        places, others, reduced_names = _partition(reduction, out.names)
        p = np.nan_to_num([values.get(name, 0.0) for name in reduced_names])
        slope, constant = _tangent(reduction, places, others, p)
        out = Linearisation(reduced_names, out.slope @ slope, out.constant + out.slope @ constant)
    return out


def _reduce(
    reduction: ParameterReduction,
    linear: Solution,
    clusters: Sequence[RowCluster],
    noise: Array | None,
    reject_noise: bool,
) -> tuple[Solution, Sequence[RowCluster], Array | None]:
    names = linear.names
    places, others, reduced_names = _partition(reduction, names)
    x = np.nan_to_num(linear.value)
    p = np.concatenate((x[others], reduction.start(x[places])))
    # The step needs only the sum over clusters; the scatter is computed at the end.
    pooled = [RowCluster("all", "all", merge(c.triangle for c in clusters), linear.rows)]
    for _ in range(REGRESSION.rounds):
        change = _transform(reduction, places, others, p)
        stepped = solve(reduced_names, _transformed(pooled, change), None, False)
        stepped_value = np.where(np.isfinite(stepped.value), stepped.value, p)
        step, p = np.abs(stepped_value - p).max(), stepped_value
        if step <= REGRESSION.tolerance * np.abs(p).max():
            break
    else:
        log.warning(
            "%s: no convergence in %d rounds", " ".join(reduction.parameters), REGRESSION.rounds
        )
    change = _transform(reduction, places, others, p)
    transformed = _transformed(clusters, change)
    moment = None if noise is None else change.T @ noise @ change
    return solve(reduced_names, transformed, moment, reject_noise), transformed, moment


def _partition(
    reduction: ParameterReduction, names: Sequence[str]
) -> tuple[list[int], list[int], tuple[str, ...]]:
    """Return the places in `names` of the reduced unknowns and of the others, and the new names."""
    places = [names.index(name) for name in reduction.linear]
    others = [i for i in range(len(names)) if i not in places]
    return places, others, (*(names[i] for i in others), *reduction.parameters)


def _transform(
    reduction: ParameterReduction, places: Sequence[int], others: Sequence[int], p: Array
) -> Array:
    """Return S (k+1, m+1) at the parameters p (m,)."""
    slope, constant = _tangent(reduction, places, others, p)
    k = len(constant)
    S = np.zeros((k + 1, len(p) + 1))
    S[:k, :-1], S[:k, -1], S[k, -1] = slope, -constant, 1.0
    return S


def _tangent(
    reduction: ParameterReduction, places: Sequence[int], others: Sequence[int], p: Array
) -> tuple[Array, Array]:
    """Return J (k, m) and c (k,) of x = J p + c at the parameters p (m,)."""
    k, count = len(places) + len(others), len(others)
    slope = np.zeros((k, len(p)))
    slope[others, np.arange(count)] = 1.0
    slope[np.ix_(places, range(count, len(p)))] = reduction.slope(p[count:])
    constant = np.zeros(k)
    constant[places] = reduction.value(p[count:]) - reduction.slope(p[count:]) @ p[count:]
    return slope, constant


def _transformed(clusters: Sequence[RowCluster], change: Array) -> list[RowCluster]:
    return [replace(c, triangle=merge([c.triangle @ change])) for c in clusters]
