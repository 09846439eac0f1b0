"""What an effect removes, and what it disturbs, by equation."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.hypothesis import Hypothesis, energy_above_noise
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH, TRACE

Array = NDArray[np.float64]


def removed_energy(winner: Hypothesis, alternative: Hypothesis) -> dict[str, float]:
    """Return the training energy that an effect removes, by equation in which it acts."""
    change = {
        e: alternative.excess_energy[e] - winner.excess_energy[e] for e in alternative.excess_energy
    }
    most = max(change.values())
    return {e: v for e, v in change.items() if v > SEARCH.acting_share * most}


def disturbed_equations(
    hypotheses: HypothesisSet, winner: Hypothesis, alternative: Hypothesis
) -> list[str]:
    """Return the equations in which an effect leaves more energy than the baseline.

    It must be more by the noise's band and by `TRACE.harm_ratio`, and more than without the effect.
    """
    before = {e: max(0.0, v) for e, v in hypotheses.empty.excess_energy.items()}
    return [
        e
        for e, now in winner.excess_energy.items()
        if now > before[e] + hypotheses.noise_band.by_equation[e]
        and now > TRACE.harm_ratio * before[e]
        and now > alternative.excess_energy[e]
    ]


def disturbed_in_held_out(
    holdout_data: RegressionData, before: Array, without: Array, after: Array
) -> list[str]:
    """Return the equations in which held-out records lose by an effect.

    Their error exceeds `TRACE.noted_ratio` noise floors, and their energy above noise exceeds that
    of the baseline by `TRACE.harm_ratio` and that without the effect. `before`, `without` and
    `after` (M,) are the whitened residuals of the baseline, and without and with the effect.
    """
    start, alone, now = (energy_above_noise(holdout_data, r) for r in (before, without, after))
    return [
        e
        for e, ratio in error_over_floor(holdout_data, after).items()
        if ratio > TRACE.noted_ratio
        and now[e] > max(TRACE.harm_ratio * max(0.0, start[e]), alone[e])
    ]


class Removal(NamedTuple):
    """The share of held-out energy that an effect removes; `in_noise`: noise hides that energy."""

    share: float
    in_noise: bool


def removal_in_words(removed: Removal, disturbed: Collection[str]) -> str:
    """Say which share of the energy an effect removes, and the equations that it disturbs."""
    text = f"{100 * removed.share:.0f} % of the energy above noise"
    if removed.in_noise:
        text = f"{100 * removed.share:.0f} % of what it would change, less than the noise"
    if not disturbed:
        return text
    equations = " ".join(sorted(disturbed))
    return f"{text}, but the residual of {equations} is larger than under the baseline"


def removal_of(
    holdout_data: RegressionData, changes: Mapping[str, float], without: Array, after: Array
) -> Removal:
    """Return what an effect removes of the held-out energy above noise.

    It is the mean over equations, weighted by the training energy that the effect removes in each
    (`changes`): an error of the baseline in another equation does not count against the effect.
    Where the held-out rows of an equation (`without` and with the effect, `after`: (M,), whitened)
    have no more energy than noise, the share is that of the effect's change which they show;
    equations where that change would not show are left out.
    """
    before, now = energy_above_noise(holdout_data, without), energy_above_noise(holdout_data, after)
    shares, above = {}, set()
    for equation in changes:  # in their order: a set's would change the sum's last digit
        if equation not in before:
            continue
        start = _residual_of(holdout_data, without, (equation,))
        change = start - _residual_of(holdout_data, after, (equation,))
        size = float(np.linalg.norm(change))
        if before[equation] > TRACE.standard_errors * np.sqrt(2.0 * len(start)):
            above.add(equation)
            shares[equation] = max(-1.0, 1.0 - max(0.0, now[equation]) / before[equation])
        elif size > 2.0 * TRACE.standard_errors:
            # 1 on average if the effect is right, 0 if there is none; the noise makes it 1 / size.
            shares[equation] = float(np.clip(start @ change / size**2, -1.0, 1.0))
    total = sum(changes[e] for e in shares)
    share = sum(changes[e] * v for e, v in shares.items()) / total if total > 0.0 else 0.0
    return Removal(share, bool(shares) and not above)


def rms_in(data: RegressionData, residual: Array, equations: Collection[str]) -> float:
    """Return the rms of whitened residuals (M,) in some equations; NaN where they have no rows."""
    part = _residual_of(data, residual, equations)
    return float(np.sqrt(np.mean(part**2))) if len(part) else float("nan")


def _residual_of(data: RegressionData, residual: Array, equations: Collection[str]) -> Array:
    """Return the part (m,) of a residual (M,) in some equations."""
    parts = [residual[s.where] for s in data.segments if s.equation in equations]
    return np.concatenate(parts) if parts else np.zeros(0)


def error_over_floor(holdout_data: RegressionData, residual: Array) -> dict[str, float]:
    """Return the held-out error of single records over the noise floor, by equation."""
    floor: dict[str, float] = {}
    energy: dict[str, float] = {}
    for s in holdout_data.segments:
        count = (s.where.stop - s.where.start) * s.repeats
        floor[s.equation] = floor.get(s.equation, 0.0) + count * s.noise**2
        # The average has less noise than a record: the difference is added.
        part = residual[s.where]
        record_energy = float(part @ part) + count * (1 - 1 / s.repeats)
        energy[s.equation] = energy.get(s.equation, 0.0) + record_energy * s.noise**2
    return {e: float(np.sqrt(energy[e] / floor[e])) for e in floor}
