"""A smaller set of effects beside a geometry within the tolerances of the rig file.

A wrong area resembles a gain of a pressure sensor, a wrong pipe volume a dead volume: on a rig
whose numbers have tolerances, the tolerances alone may explain such effects. Beside each fitted
set, the likeliest deviations g [sigma] of the numbers minimise, to first order,

    w |r + X db + D g|^2 + |g|^2,   |g_j| <= `SEARCH.most_deviations`,

with the whitened residual r (M,) of the set, its columns X (M, k), the changes D (M, J) of the
residual when each number is one sigma larger, and the share w of the rows that are independent.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from analysis.regression.least_squares import shortest
from analysis.signals.conditioning import of_other_geometry
from analysis.terms.base import Used
from analysis.trace.data.cache import RowCache
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.exact_fit import ExactFit, design_matrix, tangent
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise, is_preferred
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import SEARCH, TRACE
from rig.model.rig import Rig
from rig.model.tolerances import UncertainNumber

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Geometry:
    """A rig whose uncertain numbers are moved by `deviations` (J,) [sigma], and the set beside it.

    The shapes of the `effects` are those fitted with the stated numbers.
    """

    rig: Rig
    deviations: Array
    effects: tuple[Used, ...]


def geometry_for_smaller_set(
    hypotheses: HypothesisSet, winner: Hypothesis, explained: bool
) -> Geometry | None:
    """Return the geometry with which a set simpler than `winner` leaves as little, None if none.

    `explained`: the `winner` explains the records; then no equation may keep more than with it or
    than noise, by more than the price of the effects and numbers saved. Otherwise the other set may
    be of any size, and form error may remain.
    """
    data = hypotheses.train_data
    numbers = data.rig.uncertain_numbers
    if not numbers or not (winner.effects or not explained):
        return None
    changes = residual_changes(data, winner.fit, numbers)
    limit = len(numbers) + SEARCH.most_deviations * math.sqrt(2.0 * len(numbers))
    possible: list[tuple[Hypothesis, Array]] = []
    largest = winner if explained else min(hypotheses.fitted.values(), key=lambda o: o.total)
    for size in range(1, len(largest.effects)):
        for effects in itertools.combinations(largest.effects, size):
            hypotheses.refined(effects)  # fitted, so that the geometry is tried beside each
    for hypothesis in (hypotheses.empty, *hypotheses.fitted.values()):
        if explained and hypothesis.size >= winner.size:
            continue
        deviations, left = likeliest(data, hypothesis, changes)
        if float(deviations @ deviations) > limit:  # chi square with J degrees of freedom
            continue
        moved, band = replace(hypothesis, excess_energy=left), hypotheses.noise_band
        price = SEARCH.number_price * (sum(winner.size) - sum(hypothesis.size))
        is_as_small = all(
            v <= max(band[e], winner.excess_energy[e]) + price
            if explained
            else hypotheses.negligible(e, v)
            for e, v in left.items()
        )
        if is_as_small:
            possible.append((moved, deviations))
    if not possible:
        return None
    hypothesis, deviations = _simplest(hypotheses, possible)
    return Geometry(data.rig.with_deviations(deviations.tolist()), deviations, hypothesis.effects)


def _simplest(
    hypotheses: HypothesisSet, possible: Sequence[tuple[Hypothesis, Array]]
) -> tuple[Hypothesis, Array]:
    """Return the simplest set that leaves noise alone beside its geometry, else the preferred one.

    Shapes that compensate a wrong number are fitted again later, and leave less.
    """
    band = hypotheses.noise_band
    in_noise = [pair for pair in possible if hypotheses.within_noise(pair[0])]
    if in_noise:
        return min(in_noise, key=lambda pair: (pair[0].size, pair[0].total))
    return functools.reduce(
        lambda best, pair: pair if is_preferred(pair[0], best[0], band) else best, possible
    )


def residual_changes(
    data: RegressionData, fit: ExactFit, numbers: Sequence[UncertainNumber]
) -> Array:
    """Return the changes (M, J) of a fit's whitened residual by one sigma of each number."""
    beta = np.array(list(fit.beta.values()))

    def residual(with_rig: RegressionData) -> Array:
        rows = design_matrix(with_rig, fit.terms)
        return np.asarray(rows.rhs - rows.matrix @ beta)

    stated, columns = residual(data), []
    for number in numbers:
        other = data.rig.with_moved(number)
        moved = functools.partial(of_other_geometry, data.rig, other=other)
        records = tuple(c.with_changed_signals(moved) for c in data.records)
        columns.append(
            residual(replace(data, rig=other, records=records, cache=RowCache())) - stated
        )
    return np.column_stack(columns)


def shape_errors(data: RegressionData, fit: ExactFit) -> dict[str, float]:
    """Return the standard error of each shape of a fit by the rig's tolerances, by parameter."""
    numbers = data.rig.uncertain_numbers
    if not numbers:
        return {}
    names, columns = tangent(data, fit)
    shifts = shortest(columns, residual_changes(data, fit, numbers), TRACE.rank_limit)
    errors = dict(zip(names, map(float, np.linalg.norm(shifts.T, axis=0)), strict=True))
    return {name: error for name, error in errors.items() if name not in fit.beta}


def likeliest(
    data: RegressionData, hypothesis: Hypothesis, changes: Array
) -> tuple[Array, dict[str, float]]:
    """Return the deviations (J,) [sigma] beside a set, and the energy above noise they leave."""
    basis = orthonormal(design_matrix(data, hypothesis.fit.terms).matrix)
    projected = changes - basis @ (basis.T @ changes)
    Q, R = np.linalg.qr(projected)
    weight, bound = math.sqrt(SEARCH.independent_rows), SEARCH.most_deviations
    stacked = np.vstack((weight * R, np.eye(R.shape[1])))
    right_side = np.concatenate((-weight * (Q.T @ hypothesis.fit.residual), np.zeros(R.shape[1])))
    deviations = np.asarray(lsq_linear(stacked, right_side, bounds=(-bound, bound)).x)
    return deviations, energy_above_noise(data, hypothesis.fit.residual + projected @ deviations)
