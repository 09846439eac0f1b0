"""Sets of effects fitted exactly, found by a linear search on the regression data.

The columns searched are first-order; a set found there is refined exactly and, where something is
left, extended from data that have the set among their terms. Every set fitted on the way stays
on the list: the rivals of the winner come from it.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace.data.candidates import Variant, complexity, variants
from analysis.trace.data.regression_data import (
    RegressionData,
    VariantColumns,
    evidence,
    variant_columns,
)
from analysis.trace.search import linear_fit
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    energy_above_noise,
    noise_band,
    parameter_values,
    within_band,
)
from analysis.trace.search.refinement import ExactFit, fit_coefficients, jacobian, rebased, refine
from analysis.trace.settings import SEARCH
from rig.model.channels import place_in_words

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


class HypothesisSet:
    """Sets of effects on the same training data, fitted exactly once each."""

    def __init__(self, train_data: RegressionData, effects: Sequence[Effect]) -> None:
        self.train_data = train_data
        self.base = tuple(train_data.terms)
        self.effects = tuple(effects)
        self.noise_band = noise_band(train_data)
        self.fitted: dict[frozenset[Key], Hypothesis] = {}
        self.empty = self._hypothesis((), fit_coefficients(train_data, self.base))

    def _hypothesis(self, effects: tuple[Used, ...], fit: ExactFit) -> Hypothesis:
        rig = self.train_data.rig
        return Hypothesis(
            effects,
            fit,
            energy_above_noise(self.train_data, fit.residual),
            complexity(rig, effects),
        )

    def with_candidates(self, effects: Sequence[Effect]) -> HypothesisSet:
        """Return the sets with more candidates beside those that were searched already."""
        wide = copy.copy(self)
        wide.effects = tuple(effects)
        more = variant_columns(
            self.train_data, wide._variants(self.train_data, self.train_data.mean_residual)
        )
        wide.columns = [*self.columns, *more]
        wide.candidates = self._candidate_columns(self.train_data, wide.columns)
        wide.effects = (*self.effects, *effects)
        return wide

    def _variants(self, data: RegressionData, residual: Array) -> list[Variant]:
        """Return the candidates' points of first look on data that leave a residual (M,)."""
        seen = evidence(data, residual) if any(e.by_data for e in self.effects) else None
        return variants(data.rig, self.effects, seen)

    def physical_problem(
        self, hypothesis: Hypothesis, of: Used | None = None, formed: Collection[Key] = ()
    ) -> str:
        """Say whose number makes a set unphysical, and why ('' if none does).

        The effect `of` is asked first; its own number is stated without its name. The shapes of
        effects `formed` (name, where) are a matter of form, and may lie at their bounds.
        """
        rig = self.train_data.rig
        values = parameter_values(rig, hypothesis.fit.terms, dict(hypothesis.fit.beta))
        for used in sorted(hypothesis.effects, key=lambda used: used is not of):
            assert isinstance(used.term, Effect)
            problem = used.term.problem(rig, values, used.shape)
            if (used.term.name, used.term.where) not in formed:
                problem = problem or used.term.outside(rig, used.shape)
            if problem:
                whose = f"of {used.term.name} at {place_in_words(used.term.where)}: "
                return problem if used is of else whose + problem
        return ""

    def refined(self, effects: Sequence[Used]) -> Hypothesis:
        """Return the set refined exactly (once per set of names and places)."""
        key = frozenset((u.term.name, u.term.where) for u in effects)
        if key not in self.fitted:
            fit = refine(self.train_data, (*self.base, *effects))
            self.fitted[key] = self._hypothesis(fit.terms[len(self.base) :], fit)
        return self.fitted[key]

    def tried(self, sets: Sequence[tuple[Used, ...]]) -> list[Hypothesis]:
        """Return the sets refined exactly."""
        return [self.refined(effects) for effects in sets]

    def log_energy_ratio(self, hypothesis: Hypothesis, other: Hypothesis) -> float:
        """Return how much more one set leaves than another: the sum of log ratios over equations.

        What the form of a loud effect leaves in its own equations must not hide a quiet one in
        others, so that ratios count; what lies within the noise's band counts as nothing.
        """
        return sum(
            float(np.log((max(0.0, v) + band) / (max(0.0, other.excess_energy[e]) + band)))
            for e, v in hypothesis.excess_energy.items()
            for band in (self.noise_band.band[e],)
        )

    def is_preferred(self, hypothesis: Hypothesis, other: Hypothesis) -> bool:
        """Return whether `one` is to be preferred: much less left, or as little and simpler."""
        slack = SEARCH.number_price * max(1, abs(hypothesis.size[1] - other.size[1]))
        more, near = self.log_energy_ratio(hypothesis, other), float(np.log(SEARCH.simpler_ratio))
        if hypothesis.size < other.size:
            return more <= near or hypothesis.total <= other.total + slack
        if hypothesis.size > other.size:
            return more < -near and hypothesis.total < other.total - slack
        return hypothesis.total < other.total

    def best(self, among: Sequence[Hypothesis]) -> Hypothesis:
        """Return the preferred of several physical sets."""
        allowed = [o for o in among if not self.physical_problem(o)]
        if not allowed:
            return self.empty
        least = min(allowed, key=lambda o: o.total)
        near = [o for o in allowed if o is least or self.is_preferred(o, least)]
        return min(near, key=lambda o: (sum(o.size), o.size[0], o.total))

    def run(self, progress: Callable[[float], None] | None = None) -> Hypothesis:
        """Search: singles and pairs beside the baseline, then extensions; returns the winner.

        `progress` receives which share of the first columns is there.
        """
        self.columns = variant_columns(
            self.train_data,
            self._variants(self.train_data, self.train_data.mean_residual),
            progress,
        )
        candidates = self.candidates = self._candidate_columns(self.train_data, self.columns)
        r = self.train_data.mean_residual
        r = r - candidates.basis @ (candidates.basis.T @ r)
        return self.exchanged(self._searched(candidates, r))

    def _searched(self, candidates: linear_fit.CandidateColumns, r: Array) -> Hypothesis:
        """Return the set found on the candidates for what the baseline leaves (M,)."""
        singles = self.tried(self._singles(candidates, r))
        now = self.prune(self.best([self.empty, *singles]))
        if within_band(now.excess_energy, self.noise_band):
            return now
        pairs = self.tried(self._pairs(candidates, r, singles))
        if self.within_form_tolerance(now):
            others = [o for o in pairs if not now.keys & o.keys]
            far = [o for o in others if self.log_energy_ratio(o, now) < -SEARCH.far_log_gain]
            return self.completed_to_noise(self.prune(self.best([now, *far])))
        now = self.prune(self.best([self.empty, *singles, *pairs]))
        while (
            not within_band(now.excess_energy, self.noise_band)
            and len(now.effects) < SEARCH.largest_set
        ):
            grown = self.prune(self.best([now, *self.extensions(now)]))
            if grown.keys == now.keys or self.log_energy_ratio(now, grown) < SEARCH.least_log_gain:
                break
            now = grown
            if self.within_form_tolerance(now):
                return self.completed_to_noise(now)
        return now

    def within_form_tolerance(self, hypothesis: Hypothesis) -> bool:
        """Return whether the rest may be the difference of form between effect and catalogue."""
        return all(self.negligible(e, residual) for e, residual in hypothesis.excess_energy.items())

    def negligible(self, equation: str, residual: float) -> bool:
        """Return whether so much energy above noise may be left in an equation."""
        allowed = (SEARCH.residual_limit / SEARCH.band) ** 2 * self.noise_band.band[equation]
        return residual <= max(allowed, SEARCH.form_share * self.empty.excess_energy[equation])

    def completed_to_noise(self, now: Hypothesis) -> Hypothesis:
        """Add one more effect only if that leaves nothing but noise: else it fits a form."""
        if (
            within_band(now.excess_energy, self.noise_band)
            or len(now.effects) >= SEARCH.largest_set
        ):
            return now
        more = [o for o in self.extensions(now) if within_band(o.excess_energy, self.noise_band)]
        best = self.best(more) if more else now
        return best if best.effects and self.prune(best).keys == best.keys else now

    def _candidate_columns(
        self, data: RegressionData, columns: Sequence[VariantColumns], mask: Array | None = None
    ) -> linear_fit.CandidateColumns:
        rig = data.rig
        values = parameter_values(rig, data.terms, dict(data.beta))

        def allowed(entry: VariantColumns, coefficients: Array) -> bool:
            own = dict(zip(entry.names, map(float, coefficients), strict=True))
            # No lower bound: what is smaller than the grid's first point is fitted exactly later.
            if not 0.0 <= own.get("", 0.0) <= SEARCH.size_ratio:
                return False
            for c in entry.variant.effect.coefficients(rig):
                own.setdefault(c.parameter, 0.0)
            return not entry.variant.effect.problem(rig, {**values, **own}, entry.variant.shape)

        def size(entry: VariantColumns) -> int:
            return complexity(rig, [entry.variant.used])[1]

        return linear_fit.project(data, columns, size, allowed, mask)

    def _singles(self, candidates: linear_fit.CandidateColumns, r: Array) -> list[tuple[Used, ...]]:
        g = linear_fit.gains(
            candidates.K, candidates.columns.T @ r, candidates.groups, candidates.raw
        )
        out: dict[Key, tuple[Used, ...]] = {}
        least = SEARCH.near_gain * float(np.max(g, initial=0.0))
        for i in map(int, np.argsort(-g)):
            variant = candidates.entries[i].variant
            if (
                (g[i] > least or (g[i] > 0 and len(out) < 3))
                and variant.key not in out
                and len(out) < SEARCH.refined_singles
            ):
                out[variant.key] = (variant.used,)
        return list(out.values())

    def _pairs(
        self, candidates: linear_fit.CandidateColumns, r: Array, singles: Sequence[Hypothesis]
    ) -> list[tuple[Used, ...]]:
        chosen = linear_fit.search(candidates, r)
        out = [
            tuple(candidates.entries[m].variant.used for m in chosen.members[: SEARCH.largest_set])
        ]
        out += [
            tuple(candidates.entries[m].variant.used for m in pair.members)
            for pair in linear_fit.best_pairs(candidates, r, SEARCH.refined_pairs)
        ]
        return [effects for effects in out if len(effects) > 1]

    def extensions(
        self, now: Hypothesis, equations: Collection[str] = (), free: bool = False
    ) -> list[Hypothesis]:
        """Return sets with one more effect, found on data that have the set in their model.

        With `equations` the search looks at these alone, with `free` at free mechanisms alone.
        """
        data = rebased(self.train_data, now.fit)
        taken = now.keys
        looks = self._variants(data, now.fit.residual)
        looks = [v for v in looks if v.key not in taken and (v.effect.free or not free)]
        columns = variant_columns(data, looks)
        mask = np.ones(len(now.fit.residual))
        for s in data.segments:
            mask[s.where] = not equations or s.equation in equations
        # The set's shapes move too when another effect joins: what they can take is not its gain.
        moves = [jacobian(self.train_data, now.fit, used)[1] for used in now.effects]
        candidates = self._candidate_columns(
            replace(data, base=np.hstack((data.base, *moves))), columns, mask
        )
        r = now.fit.residual * mask
        r = r - candidates.basis @ (candidates.basis.T @ r)
        out: dict[Key, tuple[Used, ...]] = {}
        for trial in linear_fit.sets_with_one_more(candidates, (), r, 1.0):
            variant = candidates.entries[trial.members[0]].variant
            if len(out) < SEARCH.refined_extensions:
                out.setdefault(variant.key, (*now.effects, variant.used))
        return self.tried(list(out.values()))

    def exchanged(self, now: Hypothesis) -> Hypothesis:
        """Return the set, or a better one with another effect in place of one that looks like it.

        What was chosen before the last effect joined may be the wrong one beside it.
        """
        sets: list[tuple[Used, ...]] = []
        for used in now.effects if len(now.effects) > 1 else ():
            others = tuple(u for u in now.effects if u is not used)
            for effect in self.effects:
                if (effect.name, effect.where) in now.keys or not _is_confusable(effect, used):
                    continue
                fresh = Used(effect, effect.shape_of(self.train_data.rig, ()))
                sets.append((*others, fresh))
                if used.term.name in effect.includes and effect.where == used.term.where:
                    # What a richer law needs no longer may have stood for what the simpler lacks.
                    sets += [(*(u for u in others if u is not one), fresh) for one in others]
        if not sets:
            return now
        other = self.prune(self.best([now, *self.tried(sets)]))
        return now if other.keys == now.keys else self.exchanged(other)

    def extended_in(self, now: Hypothesis, equations: Collection[str]) -> Hypothesis | None:
        """Return the set with the effect added that some equations ask for, None where none is.

        What is left of a loud equation, the form of its effect, hides what a quiet one lacks as
        long as all are counted together.
        """
        if len(now.effects) >= SEARCH.largest_set:
            return None

        def residual(hypothesis: Hypothesis) -> float:
            return sum(hypothesis.excess_energy[e] for e in equations)

        def earned(hypothesis: Hypothesis) -> bool:
            drop = {e: now.excess_energy[e] - hypothesis.excess_energy[e] for e in equations}
            here = [e for e, v in drop.items() if v >= SEARCH.acting_share * max(drop.values())]
            start = sum(max(0.0, now.excess_energy[e]) for e in here)
            least = SEARCH.number_price * (hypothesis.size[1] - now.size[1])
            return sum(drop[e] for e in here) > max(least, SEARCH.add_share * start)

        more = [
            o for o in self.extensions(now, equations) if earned(o) and not self.physical_problem(o)
        ]
        if not more:
            return None
        best = min(map(residual, more))
        slack = max((SEARCH.simpler_ratio - 1.0) * max(0.0, best), SEARCH.number_price)
        near = [o for o in more if residual(o) <= best + slack]
        return min(near, key=lambda o: (o.size[1], residual(o)))

    def prune(self, hypothesis: Hypothesis) -> Hypothesis:
        """Drop effects without which about as little is left."""
        while len(hypothesis.effects) > 1:
            rest = [
                self.refined(tuple(u for u in hypothesis.effects if u is not used))
                for used in hypothesis.effects
            ]
            rest = [o for o in rest if not self.physical_problem(o)]
            simpler = [
                o
                for o in rest
                if self.is_preferred(o, hypothesis) or self.removes_too_little(o, hypothesis)
            ]
            if not simpler:
                break
            hypothesis = min(simpler, key=lambda o: o.total)
        return hypothesis

    def removes_too_little(self, without: Hypothesis, hypothesis: Hypothesis) -> bool:
        """Return whether the effect that `without` lacks takes too small a share away."""
        return self.log_energy_ratio(without, hypothesis) < -float(np.log(1.0 - SEARCH.add_share))


def _is_confusable(effect: Effect, used: Used) -> bool:
    """Return whether a named effect at the same joint is easily taken for a used one."""
    own = used.term
    assert isinstance(own, Effect)
    same = effect.mechanism == own.mechanism and effect.where == own.where
    confused = effect.name in own.confounders and _joint(effect) == _joint(own)
    return (same or confused) and not effect.free


def _joint(effect: Effect) -> list[str]:
    """Return the joint of an effect's place, or the bench."""
    return effect.where.split()[:2]


def effect_of(name: str, where: str) -> Effect:
    """Return an effect of the catalogue at a place."""
    effect = make(name, where)
    assert isinstance(effect, Effect)
    return effect
