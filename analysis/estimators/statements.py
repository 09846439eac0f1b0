"""What an estimator has to say of itself: sentences with figures, as checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.checks import Check
from analysis.estimators import nuisance as nu
from analysis.estimators.covariance import Spread
from analysis.estimators.equations import Block, Fit
from analysis.estimators.instruments import Hausman
from analysis.estimators.robust import outlying

Array = NDArray[np.float64]

MATTERS = 0.5  # standard errors: a bias of least squares below this is not worth another estimator
FEW_OUTLIERS = 0.02


@dataclass(frozen=True)
class Prepared:
    """A family's blocks, nuisance columns last, with the names of all columns."""

    family: str
    names: tuple[str, ...]
    parameters: int
    blocks: tuple[Block, ...]


def nuisance_statement(
    belief: nu.Belief, names: Sequence[str], beta: Array, error: Spread, wrong: bool
) -> Check:
    """State what the records say of a nuisance, and whether that can be."""
    i = list(names).index(belief.name)
    value, std = float(beta[i]), float(np.sqrt(error.covariance[i, i]))
    if belief.name == nu.KAPPA:
        compliance = float(beta[list(names).index("b")])
        alpha, spread_ = -100 * value / compliance, 100 * std / abs(compliance)
        said = f"b changes by {alpha:.2f} +- {2 * spread_:.2f} % per kelvin by these records"
        if spread_ > 100 * nu.SLOPE_STD:
            said = (
                "the oil's temperature hardly varied: its effect on b is taken as "
                f"{100 * nu.SLOPE:.1f} +- {200 * nu.SLOPE_STD:.1f} % per kelvin"
            )
        if wrong:
            said += ", which no oil does: b is that of the records' mean temperature"
        else:
            said += "; b is that of the rig's nominal oil temperature"
        return Check("oil temperature", not wrong, said)
    size = np.sqrt(max(value, 0.0) + 2 * std)
    said = f"laminar below a drop of {size / 1e6:.2g} MPa at most by these records"
    if wrong:
        said = (
            "the flow depends on the pressure drop in a way no orifice does (a tank pressure, a "
            "sensor's offset, a leak?); the gains are those of the plain square root"
        )
    return Check("laminar transition", not wrong, said)


def noise_statement(
    prepared: Sequence[Prepared],
    tests: Mapping[str, Hausman],
    reference: Mapping[str, tuple[Array, Spread, Fit]],
) -> Check:
    """State whether noise in the regressors biases least squares (Hausman's test)."""
    biased: list[tuple[float, str, float]] = []
    largest = (0.0, "", 0.0)
    for p in prepared:
        test, k = tests[p.family], p.parameters
        _, error, _ = reference[p.family]
        matters = MATTERS * np.sqrt(np.diag(error.covariance))
        hits = test.biased(np.concatenate((matters, np.full(len(p.names) - k, np.inf))))[:k]
        for i, name in enumerate(p.names[:k]):
            size = abs(float(test.relative[i]))
            t = float(test.difference[i] / test.error[i]) if test.error[i] > 0 else 0.0
            # The rows hold 1/b: what makes 1/b larger makes b smaller.
            entry = (size, name, t)
            if hits[i]:
                biased.append(entry)
            largest = max(largest, entry)
    if biased:
        size, name, t = max(biased)
        return Check(
            "noise in regressors", False,
            f"least squares is biased by noise in the regressors, {name} most: by "
            f"{100 * size:.2g} % against instruments from the other repeats ({abs(t):.0f} standard "
            f"errors); so are {len(biased) - 1} others; use --estimator iv or output-error",
        )  # fmt: skip
    return Check(
        "noise in regressors", True,
        f"least squares and instruments from the other repeats agree: largest difference "
        f"{100 * largest[0]:.2g} % ({largest[1]}, {abs(largest[2]):.1f} standard errors)",
    )  # fmt: skip


def outlier_statement(family: str, fit: Fit) -> Check:
    """State the share of rows that the robust loss set aside, in the worst record."""
    shares = outlying(fit)
    record, share = max(shares.items(), key=lambda item: item[1])
    return Check(
        f"outliers {family}",
        share < FEW_OUTLIERS,
        f"{100 * share:.2g} % of the rows of record {record!r} lie far outside the scatter and "
        "were left out (the worst record)",
    )
