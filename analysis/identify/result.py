"""The result of an identification, as data and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.geometry import GeometryShifts
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import RecordRows
from analysis.regression.solve import Solution, half_width
from analysis.simulation.model import Estimate, Model, estimate_json, finite
from analysis.terms.base import Coefficient, Used
from rig.model.rig import Rig

Array = NDArray[np.float64]

PLAIN = "plain"  # least squares as in the paper: no nuisances, scatter between repeats only


@dataclass(frozen=True)
class Identification:
    """The result of an identification: model, solved rows by family, masked rows, checks.

    `built` are the rows it was solved from; none where they were not all in memory. `geometry`
    holds the shifts by the rig's tolerances; None where there are none, or the method ignores them.
    """

    model: Model
    solutions: Mapping[str, Solution]
    masked_rows: int
    solve_seconds: float
    checks: tuple[Check, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)  # a method's own figures, plain data
    built: tuple[RecordRows, ...] = field(default=(), repr=False, compare=False)
    geometry: GeometryShifts | None = field(default=None, repr=False, compare=False)

    @property
    def method(self) -> str:
        """The name of the method."""
        return str(self.model.provenance["method"])

    @property
    def rows(self) -> dict[str, int]:
        """The number of rows used, by family."""
        return {family: solution.rows for family, solution in self.solutions.items()}

    @property
    def estimates(self) -> Mapping[str, Estimate]:
        """The parameters with their intervals."""
        return self.model.parameters

    def with_checks(self, checks: tuple[Check, ...], **provenance: str) -> Identification:
        """Return the result with these `checks` alone, and `provenance` added to its model's."""
        failed = [c.name for c in checks if not c.ok]
        all_provenance = {**self.model.provenance, **provenance, "checks_failed": failed}
        return replace(self, checks=checks, model=replace(self.model, provenance=all_provenance))


def to_json(result: Identification) -> dict[str, Any]:
    """Return the identification as JSON data, null for a number that is not finite."""
    geometry = {}
    if result.geometry is not None:
        geometry = {"geometry": result.geometry.to_json(result.estimates)}
    return {
        "method": result.method,
        "estimator": str(result.model.provenance.get("estimator", PLAIN)),
        "parameters": {name: estimate_json(p) for name, p in result.estimates.items()},
        "condition_number": {
            family: finite(s.condition_number) for family, s in result.solutions.items()
        },
        "rows": result.rows,
        "masked_rows": result.masked_rows,
        "solve_seconds": result.solve_seconds,
        "checks": [{"name": c.name, "ok": bool(c.ok), "detail": c.detail} for c in result.checks],
        "residual_rms": {family: finite(s.residual_rms) for family, s in result.solutions.items()},
        **geometry,
        **result.extra,
    }


def estimates_of(
    rig: Rig, terms: Sequence[Used], solutions: Mapping[str, Solution]
) -> tuple[dict[str, Estimate], Array]:
    """Turn the rows' coefficients into parameters (b = 1/coefficient) with intervals."""
    coefficients = {c.parameter: c for used in terms for c in used.term.parameters(rig)}
    estimates: dict[str, Estimate] = {}
    count = sum(len(solution.names) for solution in solutions.values())
    covariance = np.zeros((count, count))
    for solution in solutions.values():
        block = slice(len(estimates), len(estimates) + len(solution.names))
        std = np.sqrt(np.diag(solution.covariance))
        half = half_width(std, solution.dof)
        slopes = np.ones(len(std))
        for i, name in enumerate(solution.names):
            c = coefficients[name]
            note = solution.unidentifiable.get(name, "")
            estimates[name], slopes[i] = _estimate(c, solution.value[i], std[i], half[i], note)
        covariance[block, block] = solution.covariance * np.outer(slopes, slopes)
    return estimates, covariance


def _estimate(
    c: Coefficient, value: float, std: float, half: float, note: str
) -> tuple[Estimate, float]:
    """Return the parameter's estimate and d parameter / d coefficient."""
    low, high = value - half, value + half
    if not c.reciprocal:
        return Estimate(float(value), c.unit, float(std), (float(low), float(high)), note), 1.0
    if value == 0:
        return Estimate(np.nan, c.unit, np.nan, (np.nan, np.nan), "1/b is estimated as 0"), np.nan
    slope = -1.0 / value**2
    ends = reciprocal_interval(value, low, high) if value > 0 else (np.nan, np.nan)
    estimate = Estimate(float(1.0 / value), c.unit, float(abs(slope) * std), ends, note)
    return estimate, float(slope)


def reciprocal_interval(value: float, low: float, high: float) -> tuple[float, float]:
    """Return the interval of b [Pa] for an estimate of 1/b > 0 and its interval [1/Pa].

    An interval of 1/b that reaches zero leaves b open above; no hydraulic liquid exceeds
    `IDENTIFY.stiffest_liquid`.
    """
    least = min(1.0 / IDENTIFY.stiffest_liquid, value)
    return float(1.0 / high), float(1.0 / max(low, least))


def with_ends(
    estimates: Mapping[str, Estimate], ends: Mapping[str, tuple[float, float]]
) -> dict[str, Estimate]:
    """Replace intervals by the bootstrap's; `ends` are of the rows' coefficients (1/b)."""
    out = dict(estimates)
    for name, (low, high) in ends.items():
        interval = low, high
        if name == "b" and out[name].value > 0.0:
            interval = reciprocal_interval(1.0 / out[name].value, low, high)
        out[name] = replace(out[name], ci95=interval)
    return out
