"""Uncertainty of the parameters from the tolerances of a rig's areas, volumes and pin distances.

The rows of an identification take the rig's geometry as exact, so that a wrong area shifts the
parameters equally in every repeat and causes no scatter. For every number g_j of the rig file with
a tolerance sigma_j (`rig.model.tolerances`) the same records are solved again with that number
increased by sigma_j, and the shifts

    s_j = theta(g_j + sigma_j) - theta(g_j)

are added to the covariance as sum_j s_j s_j' (GUM, 5.1, to first order): a number moves all
parameters together. Intervals grow in quadrature, by 1.96 standard deviations of the sum.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.reduction import Part, RecordReduction, folded
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import RecordRows
from analysis.regression.nonlinear import reduced
from analysis.regression.rows import Rows, parameters_of, record_rows
from analysis.regression.solve import RowCluster, Solution, solve
from analysis.signals.conditioning import of_other_geometry
from analysis.simulation.model import Estimate, finite
from analysis.terms.base import FAMILIES, Used
from rig.model.rig import Rig
from rig.model.tolerances import UncertainNumber

Array = NDArray[np.float64]
Parts = Mapping[str, Sequence[Part]]  # by family: triangles of [X y] and their rows

NAME = "geometry"


@dataclass(frozen=True)
class GeometryShifts:
    """Shifts of the rows' coefficients when each of J uncertain numbers is one sigma larger.

    `shifts` holds (k, J) for each family, its coefficients in the order of `names`; those of the
    parameters in `reciprocal` are 1/parameter.
    """

    numbers: tuple[UncertainNumber, ...]
    names: Mapping[str, tuple[str, ...]]
    shifts: Mapping[str, Array]
    reciprocal: frozenset[str]

    def covariance(self, family: str) -> Array:
        """Return the covariance (k, k) that the numbers add to one family's coefficients."""
        shift = self.shifts[family]
        return np.asarray(shift @ shift.T)

    def of_parameters(self, estimates: Mapping[str, Estimate]) -> Array:
        """Return the shifts (k, J) of the parameters in the order of `estimates`, to first order.

        For a reciprocal coefficient c = 1/b that is - b^2 dc; for a parameter that is not in the
        rows 0.
        """
        order = {name: row for row, name in enumerate(estimates)}
        S = np.zeros((len(order), len(self.numbers)))
        for family, names in self.names.items():
            for name, shift in zip(names, self.shifts[family], strict=True):
                if name in order:
                    slope = -(estimates[name].value ** 2) if name in self.reciprocal else 1.0
                    S[order[name]] = slope * shift
        return S

    def uncertainties(self, estimates: Mapping[str, Estimate]) -> dict[str, float]:
        """Return each parameter's standard uncertainty due to the numbers, by name."""
        stds = np.linalg.norm(self.of_parameters(estimates), axis=1)
        return dict(zip(estimates, map(float, stds), strict=True))

    def widened(
        self, estimates: Mapping[str, Estimate], covariance: Array
    ) -> tuple[dict[str, Estimate], Array]:
        """Return the estimates and their covariance (k, k) with the tolerances included."""
        S, stds = self.of_parameters(estimates), self.uncertainties(estimates)
        grown = {name: wider(estimate, stds[name]) for name, estimate in estimates.items()}
        return grown, covariance + S @ S.T

    def to_json(self, estimates: Mapping[str, Estimate]) -> dict[str, Any]:
        """Return every number with its sigma and the shift of each parameter, in SI."""
        S = self.of_parameters(estimates)
        return {
            number.name: {
                "sigma": number.sigma,
                "shifts": {n: finite(shift) for n, shift in zip(estimates, S[:, j], strict=True)},
            }
            for j, number in enumerate(self.numbers)
        }


def shifts_of_rows(
    rig: Rig, terms: Sequence[Used], built: Sequence[RecordRows]
) -> GeometryShifts | None:
    """Return the shifts from the rows of records in memory; None for a rig without tolerances."""
    if not rig.uncertain_numbers:
        return None
    variants = map(rig.with_moved, rig.uncertain_numbers)
    moved = [folded(other, terms, _rebuilt_rows(rig, terms, built, other))[0] for other in variants]
    return _shifts(rig, terms, folded(rig, terms, (item.rows for item in built))[0], moved)


def shifts_of_reductions(
    rig: Rig,
    terms: Sequence[Used],
    reductions: Sequence[RecordReduction],
    moved: Sequence[Sequence[RecordReduction]],
) -> GeometryShifts | None:
    """Return the shifts, None without tolerances; `moved`: reductions of each changed number."""
    if not rig.uncertain_numbers:
        return None
    return _shifts(rig, terms, _parts_of(reductions), list(map(_parts_of, moved)))


def wider(estimate: Estimate, std: float) -> Estimate:
    """Return an estimate whose interval includes a further standard deviation, in quadrature."""
    value, (low, high) = estimate.value, estimate.ci95
    half = IDENTIFY.normal_quantile * std
    ends = (value - math.hypot(value - low, half), value + math.hypot(high - value, half))
    return replace(estimate, std=math.hypot(estimate.std, std), ci95=ends)


def geometry_check(estimates: Mapping[str, Estimate], geometry: GeometryShifts | None) -> Check:
    """State, for every kind of tolerance, the number and parameter with the largest shift.

    Without tolerances (`geometry` None), state that the rig file's numbers are taken as exact: a
    wrong area or pin distance may leave no residual.
    """
    if geometry is None:
        return Check(
            NAME,
            True,
            "areas, volumes and pin distances of the rig file are taken as exact: records may not "
            "show that one is wrong; state `tolerances` to have them in the intervals",
        )
    S = geometry.of_parameters(estimates)
    value = np.array([estimate.value for estimate in estimates.values()])
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.nan_to_num(S / np.abs(value)[:, None], nan=0.0, posinf=0.0, neginf=0.0)
    clauses = []
    for kind in dict.fromkeys(number.kind for number in geometry.numbers):
        of_kind = [j for j, number in enumerate(geometry.numbers) if number.kind == kind]
        k, j = np.unravel_index(np.argmax(np.abs(relative[:, of_kind])), (len(value), len(of_kind)))
        number = geometry.numbers[of_kind[int(j)]]
        percent = 100 * relative[k, of_kind[int(j)]]
        clauses.append(
            f"{number.name} ({number.stated}) moves {list(estimates)[int(k)]} by {percent:+.2g} %"
        )
    return Check(
        NAME,
        True,
        "the intervals include the tolerances of the rig file; the largest relative shift by one "
        f"standard uncertainty of each kind: {'; '.join(clauses)}",
    )


def tolerances_ignored(rig: Rig, method: str) -> Check:
    """State that a method's intervals do not include the rig file's tolerances."""
    return Check(
        NAME,
        False,
        f"the intervals of the method {method} take the geometry of {rig.name!r} as exact; "
        "--method coupled includes the tolerances of the rig file",
    )


def _rebuilt_rows(
    rig: Rig, terms: Sequence[Used], built: Sequence[RecordRows], other: Rig
) -> Iterable[Mapping[str, Rows]]:
    """Yield the rows of every record, rebuilt with the rig `other`."""
    for item in built:
        signals = of_other_geometry(rig, item.conditioned.signals, other)
        yield record_rows(other, terms, signals, item.conditioned.filtering)


def _parts_of(reductions: Sequence[RecordReduction]) -> Parts:
    return {
        family: [part for reduction in reductions for part in reduction.parts[family]]
        for family in FAMILIES
    }


def _shifts(rig: Rig, terms: Sequence[Used], base: Parts, moved: Sequence[Parts]) -> GeometryShifts:
    """Return the shifts from the triangles of the nominal rig and of each changed one."""
    names, shifts = {}, {}
    for family in FAMILIES:
        if parameters_of(rig, terms, family):
            nominal, *others = (_solved(rig, terms, family, parts) for parts in (base, *moved))
            names[family] = nominal.names
            shifts[family] = np.column_stack([s.value - nominal.value for s in others])
    reciprocal = {c.parameter for u in terms for c in u.term.coefficients(rig) if c.reciprocal}
    return GeometryShifts(rig.uncertain_numbers, names, shifts, frozenset(reciprocal))


def _solved(rig: Rig, terms: Sequence[Used], family: str, parts: Parts) -> Solution:
    """Return one family's least squares, NaN where the rows do not determine a coefficient."""
    clusters = [RowCluster(0, 0, R, rows) for R, rows in parts[family]]
    linear = solve(parameters_of(rig, terms, family), clusters)
    return reduced(rig, terms, linear, clusters)
