"""A fitted set of effects, the energy above noise that it leaves, and the noise's band."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace.data.candidates import effects_among
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.settings import SEARCH, TRACE
from rig.model.rig import Rig

Array = NDArray[np.float64]
Key = tuple[str, str]
BENCH: Final = "bench"
# Energy above noise, by equation, up to which a residual counts as noise.
NoiseBand = Mapping[str, float]


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects: its exact fit, energy above noise by equation, and `size`.

    `size` is the number of effects and of their free numbers (`candidates.complexity`).
    """

    effects: tuple[Used, ...]
    fit: ExactFit
    excess_energy: dict[str, float]
    size: tuple[int, int]

    @property
    def keys(self) -> frozenset[Key]:
        """Names and places of its effects."""
        return keys_of(self.effects)

    def without(self, used: Used) -> tuple[Used, ...]:
        """Return its effects but one."""
        return tuple(u for u in self.effects if u is not used)

    @property
    def laws(self) -> frozenset[Key]:
        """Mechanisms and places of its effects; names of one mechanism at one place are one law."""
        return frozenset(map(law_of, effects_among(self.effects)))

    @property
    def total(self) -> float:
        """Energy above noise of all equations, each counted as at least zero."""
        return sum(max(0.0, e) for e in self.excess_energy.values())


def keys_of(effects: Iterable[Used]) -> frozenset[Key]:
    """Return the names and places of effects."""
    return frozenset(u.term.key for u in effects)


def may_grow(effects: Sequence[Used], by: int = 1) -> bool:
    """Return whether a set may have so many more effects of other names (`SEARCH.most_names`)."""
    return len({used.term.name for used in effects}) + by <= SEARCH.most_names


def act_at_one_joint(effect: Effect, other: Effect) -> bool:
    """Return whether two effects are at the same joint, or one of them is of the bench."""
    places = {" ".join(e.where.split()[:2]) for e in (effect, other)}
    return len({place for place in places if not place.startswith(BENCH)}) <= 1


def law_of(effect: Effect) -> Key:
    """Return the mechanism and the place of an effect."""
    return effect.mechanism, effect.where


def is_special_case(effect: Effect, other: Effect) -> bool:
    """Return whether an effect is a special case of another one at the same place."""
    return effect.name in other.includes and effect.where == other.where


def of_one_law(effect: Effect, other: Effect) -> bool:
    """Return whether one of two effects at the same place includes the other as a special case."""
    return is_special_case(effect, other) or is_special_case(other, effect)


def negative_body(rig: Rig, fit: ExactFit, baseline: ExactFit) -> str:
    """Return in words which inertia M or weight W of a fit is negative ('' if none is).

    It must be negative beyond the noise and by `SEARCH.negative_share` of its value in the
    `baseline` fit, which must not be negative itself: a rig with a counterweight, or with angles
    counted the other way, has negative weights in both fits or states them.
    """
    share = SEARCH.negative_share
    for k, (name, value) in enumerate(fit.beta.items()):
        baseline_value = baseline.beta.get(name, 0.0)
        is_body = name[0] in "MW" and name[1:].isdigit() and rig.nominal.get(name, 0.0) >= 0.0
        if is_body and value < -share * abs(baseline_value) and baseline_value > share * value:
            scale = np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
            unit = fit.information / np.outer(scale, scale)
            inverse = np.linalg.pinv(unit, hermitian=True)
            determined = float(inverse[k] @ unit[k]) > 0.5  # 1, or 0 where the rows say nothing
            if determined and value < -TRACE.standard_errors * np.sqrt(inverse[k, k]) / scale[k]:
                return f"{name} would be {value:.4g}, below zero"
    return ""


def energy_above_noise(data: RegressionData, residual: Array) -> dict[str, float]:
    """Return the energy above noise that a residual (M,) has in each equation."""
    out: dict[str, float] = {}
    for segment in data.segments:
        part = residual[segment.where]
        excess = float(part @ part) - len(part)
        out[segment.equation] = out.get(segment.equation, 0.0) + excess
    return out


def noise_band(data: RegressionData) -> NoiseBand:
    """Return the band of every equation: `SEARCH.band` times the noise, at least 4 deviations."""
    band: dict[str, float] = {}
    rows = data.row_counts
    for s in data.segments:
        band[s.equation] = band.get(s.equation, 0.0) + SEARCH.band**2 * s.repeats * s.count
    return {e: max(v, 4 * np.sqrt(2 * rows[e])) for e, v in band.items()}


def log_energy_ratio(hypothesis: Hypothesis, other: Hypothesis, limit: NoiseBand) -> float:
    """Return the sum over equations of log((E + B) / (E' + B)), energies above noise E and E'.

    E is what `hypothesis` leaves, E' what `other` leaves, B the noise's band. Ratios are used
    so that the form error of a large effect does not hide a small effect in other equations.
    """
    return sum(
        float(np.log((max(0.0, v) + limit[e]) / (max(0.0, other.excess_energy[e]) + limit[e])))
        for e, v in hypothesis.excess_energy.items()
    )


def is_preferred(hypothesis: Hypothesis, other: Hypothesis, limit: NoiseBand) -> bool:
    """Return whether a set leaves much less than `other`, or about as little and is simpler.

    Of two equally simple sets that leave about the same in total, the one with the smaller
    `log_energy_ratio` is preferred: the total may hide a small equation that one of them disturbs.
    """
    slack = SEARCH.number_price * max(1, abs(hypothesis.size[1] - other.size[1]))
    log_ratio = log_energy_ratio(hypothesis, other, limit)
    log_tolerance = float(np.log(SEARCH.simpler_ratio))
    if hypothesis.size < other.size:
        return log_ratio <= log_tolerance or hypothesis.total <= other.total + slack
    if hypothesis.size > other.size:
        return log_ratio < -log_tolerance and hypothesis.total < other.total - slack
    similar = hypothesis.total / SEARCH.simpler_ratio, hypothesis.total * SEARCH.simpler_ratio
    if abs(log_ratio) > log_tolerance and similar[0] <= other.total <= similar[1]:
        return log_ratio < 0.0
    return hypothesis.total < other.total


def spoils_equation(hypothesis: Hypothesis, reference: Hypothesis, limit: NoiseBand) -> bool:
    """Return whether an equation keeps more than under `reference`, by more than noise."""
    before = reference.excess_energy
    return any(v > before[e] + limit[e] for e, v in hypothesis.excess_energy.items())


def removes_too_little(without: Hypothesis, hypothesis: Hypothesis, limit: NoiseBand) -> bool:
    """Return whether the effect missing in `without` removes less than `SEARCH.add_share`."""
    least = -float(np.log(1.0 - SEARCH.add_share))
    return log_energy_ratio(without, hypothesis, limit) < least


def effect_of(name: str, where: str) -> Effect:
    """Return an effect of the catalogue at a place."""
    effect = make(name, where)
    assert isinstance(effect, Effect)
    return effect
