"""The search for a set of effects: candidates ranked by their columns, then fitted exactly.

The columns are of first order in a change of signals. The best single effects and pairs are fitted
exactly and, where more than noise remains, extended from data that have the set among their terms.
Every set fitted on the way is kept, since the rivals of the winner are taken from these sets.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.signals.conditioning import Signals
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, complexity, effect_in, effects_among, variants
from analysis.trace.data.regression_data import (
    RegressionData,
    VariantColumns,
    evidence,
    signals_of,
    variant_columns,
)
from analysis.trace.search import linear_fit
from analysis.trace.search.exact_fit import (
    ExactFit,
    fit_coefficients,
    jacobian,
    parameter_values,
    rebased,
)
from analysis.trace.search.hypothesis import (
    BENCH,
    Hypothesis,
    Key,
    effect_of,
    energy_above_noise,
    is_preferred,
    keys_of,
    law_of,
    log_energy_ratio,
    may_grow,
    negative_body,
    noise_band,
    of_one_law,
    removes_too_little,
    spoils_equation,
)
from analysis.trace.search.refinement import at_best_size, refine
from analysis.trace.settings import SEARCH
from rig.model.channels import place_in_words

Array = NDArray[np.float64]


class HypothesisSet:
    """Sets of effects on the same training data, each fitted exactly once.

    `base` are the model's own terms, `effects` the candidates, `fitted` all sets fitted so far by
    names and places, `empty` the set without effects (the baseline), `noise_band` the energy that
    counts as noise. `columns` and `candidates` are set by `run`.
    """

    def __init__(self, train_data: RegressionData, effects: Sequence[Effect]) -> None:
        self.train_data = train_data
        self.base = tuple(train_data.terms)
        self.effects = tuple(effects)
        self.noise_band = noise_band(train_data)
        self.fitted: dict[frozenset[Key], Hypothesis] = {}
        self.empty = self.at_given_shapes(())

    def _hypothesis(self, effects: tuple[Used, ...], fit: ExactFit) -> Hypothesis:
        rig = self.train_data.rig
        excess_energy = energy_above_noise(self.train_data, fit.residual)
        return Hypothesis(effects, fit, excess_energy, complexity(rig, effects))

    def at_given_shapes(self, effects: Sequence[Used]) -> Hypothesis:
        """Return the fit of a set of effects with the shapes that they have."""
        fit = fit_coefficients(self.train_data, (*self.base, *effects))
        return self._hypothesis(fit.terms[len(self.base) :], fit)

    def with_candidates(self, effects: Sequence[Effect]) -> HypothesisSet:
        """Return a copy with further candidates, which shares the sets fitted so far."""
        extended = copy.copy(self)
        extended.effects = tuple(effects)
        data = self.train_data
        new_columns = variant_columns(data, extended.variants_of(data, data.mean_residual))
        extended.columns = [*self.columns, *new_columns]
        extended.candidates = self._candidate_columns(data, extended.columns)
        extended.effects = (*self.effects, *effects)
        return extended

    def variants_of(self, data: RegressionData, residual: Array) -> list[Used]:
        """Return the candidates at every point of their shape grids.

        `residual` (M,) of the data places the points of effects whose grid depends on the data.
        """
        grid_evidence = evidence(data, residual) if any(e.by_data for e in self.effects) else None
        return variants(data.rig, self.effects, grid_evidence)

    def physical_problem(
        self,
        hypothesis: Hypothesis,
        first: Used | None = None,
        may_be_at_bounds: Collection[Key] = (),
    ) -> str:
        """Return in words which number of a set is physically impossible ('' if none is).

        The effect `first` is tested first, and its problem stated without its name. Shapes of the
        effects `may_be_at_bounds` (name, where) may lie at their bounds.
        """
        rig = self.train_data.rig
        values = hypothesis.fit.parameters(rig)
        for used in sorted(hypothesis.effects, key=lambda used: used is not first):
            effect, terms = effect_in(used), hypothesis.fit.terms
            for name in effect.excludes:
                if (name, effect.where) in hypothesis.keys:
                    return f"{effect.name} and {name} exclude each other at one place"
            problem = effect.problem(rig, values, used.shape)
            problem = problem or effect.not_shown(rig, values, used.shape, terms, self._signals)
            if effect.key not in may_be_at_bounds:
                problem = problem or effect.outside(rig, used.shape)
            if problem:
                whose = f"of {effect.name} at {place_in_words(effect.where)}: "
                return problem if used is first else whose + problem
        return negative_body(rig, hypothesis.fit, self.empty.fit)

    def refined(self, effects: Sequence[Used], rival: Hypothesis | None = None) -> Hypothesis:
        """Return the exact fit of a set of effects, computed once for its names and places.

        The search of its shapes ends early where it promises no improvement on the set `rival`.
        """
        if not effects:
            return self.empty
        key = keys_of(effects)
        if key not in self.fitted:
            rival_fit = None if rival is None else rival.fit
            fit = refine(self.train_data, (*self.base, *effects), rival_fit)
            self.fitted[key] = self._hypothesis(fit.terms[len(self.base) :], fit)
        return self.fitted[key]

    def refined_anew(self, effects: Sequence[Used]) -> Hypothesis:
        """Return the best exact fit of a set: the earlier one, or one that starts at these shapes.

        Otherwise a further effect could seem to remove what a local minimum has left.
        """
        earlier = self.refined(effects)
        if set(effects) != set(earlier.effects):
            del self.fitted[earlier.keys]
            if self.refined(effects).total > earlier.total:
                self.fitted[earlier.keys] = earlier
        return self.fitted[earlier.keys]

    def refined_below(self, energy: float, effects: Sequence[Used]) -> Hypothesis:
        """Return the exact fit of a set whose shapes in `effects` leave `energy`, or less.

        An earlier fit that leaves more ended in a local minimum and is repeated from these shapes.
        """
        earlier = self.refined(effects)
        return earlier if earlier.fit.energy <= energy else self.refined_anew(effects)

    def replacements(
        self, winner: Hypothesis, used: Used, by: int = 1
    ) -> Iterator[tuple[Hypothesis, list[Used]]]:
        """Yield the fitted sets with `by` other effects in the place of `used`, and these."""
        key = used.term.key
        others = winner.keys - {key}
        for hypothesis in self.fitted.values():
            fresh = [u for u in hypothesis.effects if u.term.key not in winner.keys]
            if key not in hypothesis.keys and others <= hypothesis.keys and len(fresh) == by:
                yield hypothesis, fresh

    def best(self, among: Sequence[Hypothesis]) -> Hypothesis:
        """Return the simplest physical set `among` those that leave about the least, else `empty`.

        Where an effect equals a simpler one that it includes, the set with that one is tried too.
        """
        physical = [o for o in (*among, *self._simpler_sets(among)) if not self.physical_problem(o)]
        if not physical:
            return self.empty

        def preferred(one: Hypothesis, other: Hypothesis) -> Hypothesis:
            return other if is_preferred(other, one, self.noise_band) else one

        best = min(physical, key=lambda o: o.total)
        best = functools.reduce(preferred, (o for o in physical if o.size == best.size), best)
        similar = [o for o in physical if o is best or is_preferred(o, best, self.noise_band)]
        least_size = min((sum(o.size), o.size[0]) for o in similar)
        return functools.reduce(
            preferred, (o for o in similar if (sum(o.size), o.size[0]) == least_size)
        )

    def _simpler_sets(self, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the sets with an effect replaced by a simpler one that it equals."""
        rig, out = self.train_data.rig, []
        in_model = {u.term.key for u in self.base}
        for hypothesis in among:
            values = hypothesis.fit.parameters(rig)
            for used in hypothesis.effects:
                name, where = effect_in(used).simpler_equivalent(rig, values), used.term.where
                if name and (name, where) not in in_model | hypothesis.keys:
                    simple = at_start(rig, effect_of(name, where))
                    out.append(self.refined([*hypothesis.without(used), simple]))
        return out

    def run(self, progress: Callable[[float], None] | None = None) -> Hypothesis:
        """Search single effects, pairs and extensions, and return the best set.

        `progress` is called with the share of the candidates' columns that is computed.
        """
        data, r = self.train_data, self.train_data.mean_residual
        self.columns = variant_columns(data, self.variants_of(data, r), progress)
        candidates = self.candidates = self._candidate_columns(data, self.columns)
        r = r - candidates.basis @ (candidates.basis.T @ r)
        result = self._searched(candidates, r)
        return self.fitted.get(result.keys, result)  # a later start may have found better shapes

    def _searched(self, candidates: linear_fit.CandidateColumns, r: Array) -> Hypothesis:
        """Return the best set for the baseline's residual r (M,), orthogonal to its columns."""
        band = self.noise_band
        singles = [self.refined(effects) for effects in self._best_singles(candidates, r)]
        current = self.prune(self.best([self.empty, *singles]))
        if self.within_noise(current):
            return current
        pairs = [
            self.refined([candidates.entries[m].used for m in pair.members])
            for pair in (
                *linear_fit.best_pairs(candidates, r),
                *linear_fit.pairs_of_chambers(candidates, r),
            )
        ]
        if self.within_form_tolerance(current):
            others = [o for o in pairs if not current.keys & o.keys]
            far = [o for o in others if log_energy_ratio(o, current, band) < -SEARCH.far_log_gain]
            return self.completed_to_noise(self.prune(self.best([current, *far])), pairs)
        current = self._grown(self.prune(self.best([self.empty, *singles, *pairs])))
        if self.within_form_tolerance(current):
            return current
        return self._grown(self._begun_with_another(current, singles))

    def _begun_with_another(self, current: Hypothesis, singles: Sequence[Hypothesis]) -> Hypothesis:
        """Return the set, or a better pair that begins with a single effect which it lacks.

        A cross-talk may leave less than the true gain while a second effect is missing, and no
        further effect beside the cross-talk explains what it leaves.
        """
        others = [o for o in singles if not o.keys & current.keys and not self.physical_problem(o)]
        nearest = sorted(others, key=lambda o: o.total)[: SEARCH.other_starts]
        pairs = [pair for single in nearest for pair in self.extensions(single)]
        return self.prune(self.best([current, *pairs]))

    def _grown(self, current: Hypothesis) -> Hypothesis:
        """Return the set with further effects, while each leaves enough less and more than noise.

        A set within the tolerance for its forms grows only to one that leaves noise alone.
        """
        band = self.noise_band
        while not self.within_noise(current) and may_grow(current.effects):
            grown = self.prune(self.best([current, *self.extensions(current)]))
            if (
                grown.keys == current.keys
                or log_energy_ratio(current, grown, band) < SEARCH.least_log_gain
            ):
                break
            current = grown
            if self.within_form_tolerance(current):
                return self.completed_to_noise(current)
        return current

    def within_noise(self, hypothesis: Hypothesis) -> bool:
        """Return whether every equation's energy above noise lies within the noise's band."""
        return all(v <= self.noise_band[e] for e, v in hypothesis.excess_energy.items())

    def within_form_tolerance(self, hypothesis: Hypothesis) -> bool:
        """Return whether every equation keeps no more than noise or the effects' form error."""
        return all(self.negligible(e, energy) for e, energy in hypothesis.excess_energy.items())

    def negligible(self, equation: str, energy: float) -> bool:
        """Return whether an equation's energy above noise is within noise or form error.

        That is `SEARCH.residual_limit` as an rms over the noise, or `SEARCH.form_share` of what the
        baseline leaves.
        """
        allowed = (SEARCH.residual_limit / SEARCH.band) ** 2 * self.noise_band[equation]
        return energy <= max(allowed, SEARCH.form_share * self.empty.excess_energy[equation])

    def completed_to_noise(
        self, current: Hypothesis, others: Sequence[Hypothesis] = ()
    ) -> Hypothesis:
        """Return a set within form error, or a larger or another one if that leaves noise alone.

        An effect that leaves less, but more than noise, would only fit the form error.
        """
        if self.within_noise(current) or not may_grow(current.effects):
            return current
        larger = [*self.extensions(current), *others]
        best = self.best([o for o in larger if self.within_noise(o)])
        return best if best.effects and self.prune(best).keys == best.keys else current

    def _candidate_columns(
        self, data: RegressionData, columns: Sequence[VariantColumns], mask: Array | None = None
    ) -> linear_fit.CandidateColumns:
        rig = data.rig
        values = parameter_values(rig, data.terms, data.beta)

        def allowed(entry: VariantColumns, coefficients: Array) -> bool:
            sizes = dict(zip(entry.names, map(float, coefficients), strict=True))
            # No lower bound: a size below that of the grid's first point is fitted exactly later.
            if not 0.0 <= sizes.get("", 0.0) <= SEARCH.size_ratio:
                return False
            effect = effect_in(entry.used)
            if effect.free:  # its curve may be physical only with the details of its form
                return True
            for c in effect.coefficients(rig):
                sizes.setdefault(c.parameter, 0.0)
            return not effect.problem(rig, {**values, **sizes}, entry.used.shape)

        def size(entry: VariantColumns) -> int:
            return complexity(rig, [entry.used])[1]

        return linear_fit.project(data, columns, size, allowed, mask)

    def _best_singles(
        self, candidates: linear_fit.CandidateColumns, r: Array
    ) -> list[tuple[Used, ...]]:
        g = linear_fit.gains(
            candidates.K, candidates.columns.T @ r, candidates.groups, candidates.visibility_limit
        )
        out: dict[Key, tuple[Used, ...]] = {}
        least = SEARCH.near_gain * float(np.max(g, initial=0.0))
        for i in map(int, np.argsort(-g)):
            used = candidates.entries[i].used
            if (
                (g[i] > least or (g[i] > 0 and len(out) < 3))
                and used.term.key not in out
                and len(out) < SEARCH.refined_singles
            ):
                out[used.term.key] = (used,)
        return list(out.values())

    def extensions(
        self, current: Hypothesis, equations: Collection[str] = (), free: bool = False
    ) -> list[Hypothesis]:
        """Return the best sets with one more effect, found on data with the set in their model.

        `equations` restricts the search to their rows, `free` to free mechanisms. A free mechanism
        and a name of it are not combined at one place: one would fit the other's form error.
        """
        data, taken, laws = rebased(self.train_data, current.fit), current.keys, current.laws
        members = effects_among(current.effects)
        curves = {law_of(e) for e in members if e.free}
        tried = [
            used
            for used in self.variants_of(data, current.fit.residual)
            for effect in (effect_in(used),)
            if effect.key not in taken and (not free or effect.free)
            and law_of(effect) not in (laws if effect.free else curves)
            and self.may_act(effect, current, equations)
        ]  # fmt: skip
        columns = variant_columns(data, tried, equations=equations)
        mask = data.in_equations(equations or data.row_counts).astype(np.float64)
        starts = self.best_additions(data, current, columns, mask)[: SEARCH.refined_extensions]
        larger = [self.extended(current, effects) for effects in starts]
        if free:
            return larger
        with_parts: dict[frozenset[Key], tuple[Used, ...]] = {}
        # Alone, a sensor's gain is fitted far from its size beside an offset, and the reverse.
        for effect in self.effects if may_grow(current.effects) else ():
            goes_with = any(map(effect.is_alternative_to_detail, members))
            if goes_with and not any(effect.key in o.keys for o in (current, *larger)):
                grown = (*current.effects, at_start(self.train_data.rig, effect))
                with_parts[keys_of(grown)] = grown
        for hypothesis in (current, *filter(self.physical_problem, larger)):
            for effects in self.with_parts_beside(hypothesis, equations):
                with_parts.setdefault(keys_of(effects), effects)
        return larger + [self.extended(current, effects) for effects in with_parts.values()]

    def best_additions(
        self, data: RegressionData, current: Hypothesis, columns: Sequence[VariantColumns],
        mask: Array | None = None,
    ) -> list[tuple[Used, ...]]:  # fmt: skip
        """Return the set with each candidate, in the order of what they leave by their columns.

        `data` have the set in their model; `mask` (M,) is 0 for rows that do not count.
        """
        candidates, r = self.candidates_beside(data, current, columns, mask)
        starts: dict[Key, tuple[Used, ...]] = {}
        for trial in linear_fit.sets_with_one_more(candidates, (), r):
            used = candidates.entries[trial.members[0]].used
            starts.setdefault(used.term.key, (*current.effects, used))
        return list(starts.values())

    def candidates_beside(
        self, data: RegressionData, current: Hypothesis, columns: Sequence[VariantColumns],
        mask: Array | None = None,
    ) -> tuple[linear_fit.CandidateColumns, Array]:  # fmt: skip
        """Return candidates and residual (M,), orthogonal to what the set can remove itself.

        The set's shapes are fitted again beside a new effect: energy that they can remove is no
        gain of that effect.
        """
        moves = (jacobian(self.train_data, current.fit, used)[1] for used in current.effects)
        absorbing = replace(data, base=np.hstack((data.base, *moves)))
        candidates = self._candidate_columns(absorbing, columns, mask)
        r = current.fit.residual if mask is None else current.fit.residual * mask
        return candidates, r - candidates.basis @ (candidates.basis.T @ r)

    def with_parts_beside(
        self, hypothesis: Hypothesis, equations: Collection[str] = ()
    ) -> Iterator[tuple[Used, ...]]:
        """Yield the sets with another part of an effect's law beside it, both at their start.

        Alone, a breakaway is fitted far from its size beside Coulomb friction: first-order columns
        do not show the pair, and each alone may be physically impossible.
        """
        rig = self.train_data.rig
        if not may_grow(hypothesis.effects):
            return
        for used in hypothesis.effects:
            member = effect_in(used)
            for effect in self.effects:
                part = of_one_law(effect, member) and (effect.beside or member.beside)
                acts = not equations or self._acting.get(effect.key, set()) & set(equations)
                if part and acts and effect.key not in hypothesis.keys:
                    yield (*hypothesis.without(used), at_start(rig, member), at_start(rig, effect))

    def extended(self, current: Hypothesis, effects: Sequence[Used]) -> Hypothesis:
        """Return the exact fit of a set that extends `current`, with its shapes as starting points.

        A new effect starts at the size that leaves least. Where an equation keeps more than under
        `current`, an earlier fit of the same set ended in a local minimum and is repeated.
        """
        added = [u for u in effects if u.term.key not in current.keys]
        others = [u for u in effects if u not in added]
        effects = [*others, *(at_best_size(self.train_data, u, others) for u in added)]
        earlier = self.refined(effects)
        spoils = spoils_equation(earlier, current, self.noise_band)
        return self.refined_anew(effects) if spoils else earlier

    def may_act(self, effect: Effect, current: Hypothesis, equations: Collection[str]) -> bool:
        """Return whether a candidate may have columns in some of `equations`, true without any.

        They are those in which it has columns under the baseline. Beside an effect of the bench,
        which couples the joints' flows, it may act in any.
        """
        coupled = any(u.term.where.startswith(BENCH) for u in current.effects)
        if not equations or coupled or effect.key not in self._acting:
            return True
        return not self._acting[effect.key].isdisjoint(equations)

    @functools.cached_property
    def _signals(self) -> list[Signals]:
        return signals_of(self.train_data)

    @functools.cached_property
    def _acting(self) -> dict[Key, set[str]]:
        """Equations in which each candidate has columns under the baseline."""
        out: dict[Key, set[str]] = {}
        for entry in self.columns:
            out.setdefault(entry.used.term.key, set()).update(entry.touched)
        return out

    def extended_in(self, current: Hypothesis, equations: Collection[str]) -> Hypothesis | None:
        """Return the set with the effect that removes most from `equations`, None if none does.

        Other equations do not count: the form error of a large effect there would hide a small one
        here. A set that leaves as little in `equations` with fewer effects is returned instead.
        """
        if not may_grow(current.effects):
            return None

        def remaining(hypothesis: Hypothesis) -> float:
            return sum(hypothesis.excess_energy[e] for e in equations)

        def removes_enough(hypothesis: Hypothesis) -> bool:
            drop = {e: current.excess_energy[e] - hypothesis.excess_energy[e] for e in equations}
            acting = [e for e, v in drop.items() if v >= SEARCH.acting_share * max(drop.values())]
            start = sum(max(0.0, current.excess_energy[e]) for e in acting)
            least = SEARCH.number_price * (hypothesis.size[1] - current.size[1])
            return sum(drop[e] for e in acting) > max(least, SEARCH.add_share * start)

        tried = self.extensions(current, equations)
        tried += self._simpler_sets(tried)
        tried += self._smaller_sets(current, tried)
        useful = [o for o in tried if removes_enough(o) and not self.physical_problem(o)]
        if not useful:
            return None
        least = min(map(remaining, useful))
        slack = max((SEARCH.simpler_ratio - 1.0) * max(0.0, least), SEARCH.number_price)
        similar = [o for o in useful if remaining(o) <= least + slack]
        return min(similar, key=lambda o: (sum(o.size), remaining(o)))

    def _smaller_sets(self, current: Hypothesis, tried: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the fitted sets of fewer effects than `tried`, none larger, none spoiling one."""
        least = min(((o.size[0], sum(o.size)) for o in tried), default=(0, 0))
        return [
            o
            for o in self.fitted.values()
            if 0 < o.size[0] < least[0] and sum(o.size) <= least[1]
            and not spoils_equation(o, current, self.noise_band)
        ]  # fmt: skip

    def prune(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return the set without effects that are not needed or remove too little."""
        band = self.noise_band
        while len(hypothesis.effects) > 1:
            smaller = [self.refined_anew(hypothesis.without(used)) for used in hypothesis.effects]
            smaller = [o for o in smaller if not self.physical_problem(o)]
            simpler = [
                o
                for o in smaller
                if is_preferred(o, hypothesis, band) or removes_too_little(o, hypothesis, band)
            ]
            if not simpler:
                break
            hypothesis = min(simpler, key=lambda o: o.total)
        return hypothesis
