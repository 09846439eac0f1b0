"""Models drawn within the intervals of an identified model, and checks of it as the twin.

A draw moves all parameters at once by one equivalent standard error in every principal direction
of their relative covariance, forwards or backwards by a sign. Over `count` draws the signs of the
`count` widest directions are columns of a Hadamard matrix, hence orthogonal (Plackett and Burman,
Biometrika 33, 1946): for a quantity g that is linear in the parameters the mean square of
g(draw) - g(estimate) over the draws is exactly the variance that these directions cause, and
unbiased in the rest, whose signs are random.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.linalg import hadamard

from analysis.simulation.model import Array, Estimate, Model, rig_difference
from analysis.simulation.settings import SIMULATION
from analysis.terms import BASELINE
from rig.model.parameters import is_positive
from rig.model.rig import Rig

SIGMAS: Final = 2.0  # equivalent standard errors to the edge of a 95 % interval


def equivalent_errors(model: Model) -> Array:
    """Return half the half width of each 95 % interval (k,), in the parameters' units.

    With few repeats an interval is wider than two standard errors; the draws follow the interval.
    """
    return np.array([_wider_half(p) for p in model.parameters.values()]) / SIGMAS


def _wider_half(p: Estimate) -> float:
    """Return the wider half of a parameter's 95 % interval."""
    return max(p.ci95[1] - p.value, p.value - p.ci95[0])


def model_draws(model: Model, count: int, rng: np.random.Generator) -> list[Model]:
    """Return `count` (a power of two) models around `model`; none if nothing is uncertain.

    Correlations are those of the model's covariance; unknown ones count as zero.
    """
    errors = equivalent_errors(model)
    if not errors.any():
        return []
    values = np.array([p.value for p in model.parameters.values()])
    std = np.sqrt(np.diag(model.covariance))
    scale = np.where(values == 0.0, 1.0, np.abs(values))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = model.covariance / np.outer(std, std)
        relative = errors / scale
    correlation[~np.isfinite(correlation)] = 0.0
    np.fill_diagonal(correlation, 1.0)
    variance, directions = np.linalg.eigh(correlation * np.outer(relative, relative))
    widest = np.argsort(variance)[::-1]
    root = directions[:, widest] * np.sqrt(np.maximum(variance[widest], 0.0))
    signs = rng.choice((-1.0, 1.0), size=(count, len(values)))
    exact = min(count, len(values))
    signs[:, :exact] = hadamard(count)[:, :exact] * rng.choice((-1.0, 1.0), size=exact)
    return [_with_values(model, values + scale * (root @ row)) for row in signs]


def _with_values(model: Model, values: Sequence[float] | Array) -> Model:
    parameters = {
        name: replace(p, value=float(value))
        for (name, p), value in zip(model.parameters.items(), values, strict=True)
    }
    return replace(model, parameters=parameters)


def unusable(model: Model, rig: Rig) -> str:
    """Return why a model cannot be the twin of a rig, as a clause ('' if it can)."""
    difference = rig_difference(model.rig, rig)
    if difference:
        return f"it was identified on another rig: {difference}"
    missing = [name for name, p in model.parameters.items() if not p.identified]
    if missing:
        return f"it does not determine {' '.join(missing)}"
    unknown = [
        name
        for name, error in zip(model.parameters, equivalent_errors(model), strict=True)
        if np.isnan(error)
    ]
    if unknown:
        return f"it has no intervals for {' '.join(unknown)}"
    return _implausible(model, rig)


def _implausible(model: Model, rig: Rig) -> str:
    """Return which parameter the machine cannot have or the data hardly determine ('' if none)."""
    for name in filter(is_positive, _baseline_parameters(model)):
        p = model.parameters[name]
        if p.value <= 0.0:
            return f"its {name} is {p.value:.3g} {p.unit}, expected more than 0"
    for name in _baseline_parameters(model, "fluid"):
        p = model.parameters[name]
        half = _wider_half(p)
        if half > SIMULATION.widest_interval * p.value:
            return (
                f"its {name} is known to +- {100 * half / p.value:.0f} % only, expected "
                f"{100 * SIMULATION.widest_interval:.0f} % or less"
            )
    far = far_from_nominal(rig, model.values)
    return f"it has {far}" if far else ""


def far_from_nominal(rig: Rig, values: Mapping[str, float]) -> str:
    """Name the positive parameters a factor away from the rig's nominal values ('' if none).

    The factor, `SIMULATION.far_from_nominal`, is one of a wrong unit or of a wrong gain.
    """
    factor = SIMULATION.far_from_nominal
    ratio = {n: values[n] / rig.nominal[n] for n in rig.nominal if n in values and is_positive(n)}
    far = [f"{n} {r:.2g}" for n, r in ratio.items() if r > factor or 0.0 < r < 1.0 / factor]
    if not far:
        return ""
    return (
        f"{', '.join(far)} times the nominal value of the rig file, expected within a factor of "
        f"{factor:g}: is a channel in another unit, or is the nominal value wrong?"
    )


def _baseline_parameters(model: Model, family: str | None = None) -> list[str]:
    """Name the parameters of the baseline's terms, or of those in one family of rows."""
    return [
        c.parameter
        for used in model.terms
        if used.term.name in BASELINE
        for c in used.term.parameters(model.rig)
        if family in (None, c.family)
    ]
