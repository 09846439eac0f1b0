"""How often intervals hold the truth, how large bias and scatter are: sums over experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta as beta_law

from analysis.identify.estimators.shifts import NOISE_CHECK
from analysis.identify.result import Identification

GOAL = (0.92, 0.98)
MOST_BIAS, MOST_BIAS_OF_B = 0.005, 0.02  # relative


@dataclass(frozen=True)
class Trial:
    """One experiment by one estimator: relative error and 95 % interval about the truth.

    `error` is value/truth - 1, `low` and `high` the interval's ends likewise; NaN where a
    parameter was not identified. `flagged` says that a check found noise in the regressors, `used`
    who estimated in the end, `seconds` the processor's time from records to parameters, `taking`
    that which taking the records took.
    """

    error: Mapping[str, float]
    low: Mapping[str, float]
    high: Mapping[str, float]
    flagged: bool = False
    used: str = ""
    seconds: float = 0.0
    taking: float = 0.0


@dataclass(frozen=True)
class Row:
    """One parameter over all experiments: shares and relative figures (not percent)."""

    name: str
    count: int
    coverage: float
    coverage_low: float
    coverage_high: float
    bias: float
    bias_error: float
    rsd: float
    half_width: float

    @property
    def bias_kept(self) -> bool:
        """Whether the bias is within what is wanted."""
        return abs(self.bias) <= (MOST_BIAS_OF_B if self.name == "b" else MOST_BIAS)


def trial(
    found: Identification, truth: Mapping[str, float], seconds: float = 0.0, taking: float = 0.0
) -> Trial:
    """Return an identification seen from its truth."""
    known = {n: e for n, e in found.estimates.items() if n in truth}
    flagged = any(c.name == NOISE_CHECK and not c.ok for c in found.checks)
    return Trial(
        {n: e.value / truth[n] - 1 for n, e in known.items()},
        {n: e.ci95[0] / truth[n] - 1 for n, e in known.items()},
        {n: e.ci95[1] / truth[n] - 1 for n, e in known.items()},
        flagged,
        str(found.model.provenance.get("estimator", "")),
        seconds,
        taking,
    )


def rows(trials: Sequence[Trial]) -> list[Row]:
    """Return a row per parameter; coverage has its own 95 % interval (Clopper and Pearson)."""
    out = []
    for name in trials[0].error:
        error = np.array([t.error.get(name, np.nan) for t in trials])
        low = np.array([t.low.get(name, np.nan) for t in trials])
        high = np.array([t.high.get(name, np.nan) for t in trials])
        good = np.isfinite(error) & np.isfinite(low) & np.isfinite(high)
        n = int(good.sum())
        if n < 2:
            continue
        hits = int(((low <= 0) & (high >= 0) & good).sum())
        spread = float(error[good].std(ddof=1))
        out.append(
            Row(
                name, n, hits / n, *_between(hits, n),
                float(error[good].mean()), spread / np.sqrt(n), spread,
                float(np.mean(0.5 * (high - low)[good])),
            )
        )  # fmt: skip
    return out


def overall(found: Sequence[Row]) -> float:
    """Return the coverage over all parameters."""
    return sum(r.coverage * r.count for r in found) / sum(r.count for r in found)


def _between(hits: int, n: int) -> tuple[float, float]:
    low = beta_law.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta_law.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return float(low), float(high)
