"""The sets of effects fitted in a search, and the choice among them.

Every set that is fitted is kept, since the rivals of the winner are taken from these sets.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.signals.conditioning import Signals
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, complexity, effect_in, variants
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
    parameter_values,
)
from analysis.trace.search.hypothesis import (
    Hypothesis,
    Key,
    effect_of,
    energy_above_noise,
    is_preferred,
    keys_of,
    negative_body,
    noise_band,
    removes_too_little,
)
from analysis.trace.search.refinement import refine
from analysis.trace.settings import SEARCH
from analysis.workers.pool import Pool, Serial
from rig.model.channels import place_in_words

Array = NDArray[np.float64]
T = TypeVar("T")
_Fitted = tuple[Hypothesis, bool]  # and whether its effects have kept their forms


class HypothesisSet:
    """Sets of effects on the same training data, each fitted exactly once.

    `base` are the model's own terms, `effects` the candidates, `fitted` all sets fitted so far by
    names and places, `empty` the set without effects (the baseline), `noise_band` the energy that
    counts as noise. `columns` and `candidates` are set by `compute_columns`. `progress` is called
    with the share of the candidates' columns that is computed, and again after each fitted set.
    `pool` computes what `each` is given.
    """

    def __init__(
        self, train_data: RegressionData, effects: Sequence[Effect],
        progress: Callable[[float], None] = lambda _: None, pool: Pool | None = None,
    ) -> None:  # fmt: skip
        self.train_data = train_data
        self.base = tuple(train_data.terms)
        self.effects = tuple(effects)
        self.noise_band = noise_band(train_data)
        self.fitted: dict[frozenset[Key], Hypothesis] = {}
        self._in_form: set[frozenset[Key]] = set()
        self._progress = progress
        self.pool = pool or Serial()
        self.empty = self.at_given_shapes(())

    def _hypothesis(self, effects: tuple[Used, ...], fit: ExactFit) -> Hypothesis:
        rig = self.train_data.rig
        excess_energy = energy_above_noise(self.train_data, fit.residual)
        return Hypothesis(effects, fit, excess_energy, complexity(rig, effects))

    def each(
        self, function: Callable[[HypothesisSet, T], Hypothesis], items: Iterable[T]
    ) -> list[Hypothesis]:
        """Return the fitted sets function(sets, item) of all items, computed by the pool.

        `sets` is a copy of this object with the sets fitted so far, so that the results do not
        depend on the number of processes. What an item fits is kept; of two fits of one set the
        better one.
        """
        fitted, here = dict(self.fitted), os.getpid()

        def fitted_by(item: T) -> tuple[frozenset[Key], dict[frozenset[Key], _Fitted]]:
            sets = copy.copy(self)
            sets.fitted, sets._in_form = dict(fitted), set(self._in_form)
            if os.getpid() != here:  # another process does not report
                sets._progress = lambda _: None
            keys = function(sets, item).keys
            new = {k: (o, k in sets._in_form) for k, o in sets.fitted.items()}
            return keys, {k: entry for k, entry in new.items() if entry[0] is not fitted.get(k)}

        results = list(self.pool.map(fitted_by, items))
        for _, new in results:
            for key, (hypothesis, in_form) in new.items():
                known = self.fitted.get(key)
                if known is None or known is fitted.get(key) or hypothesis.total < known.total:
                    self.fitted[key] = hypothesis
                    (self._in_form.add if in_form else self._in_form.discard)(key)
        return [self.fitted[keys] if keys else self.empty for keys, _ in results]

    def at_given_shapes(self, effects: Sequence[Used]) -> Hypothesis:
        """Return the fit of a set of effects with the shapes that they have."""
        fit = fit_coefficients(self.train_data, (*self.base, *effects))
        return self._hypothesis(fit.terms[len(self.base) :], fit)

    def compute_columns(self) -> None:
        """Compute the candidates' columns under the baseline."""
        data = self.train_data
        candidates = self.variants_of(data, data.mean_residual)
        self.columns = variant_columns(data, candidates, self._progress, pool=self.pool)
        self.candidates = self.candidate_columns(data, self.columns)

    def with_candidates(self, effects: Sequence[Effect]) -> HypothesisSet:
        """Return a copy with further candidates, which shares the sets fitted so far."""
        extended, data = copy.copy(self), self.train_data
        extended.effects = tuple(effects)
        candidates = extended.variants_of(data, data.mean_residual)
        further = variant_columns(data, candidates, pool=self.pool)
        extended.columns = [*self.columns, *further]
        extended.candidates = self.candidate_columns(data, extended.columns)
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
        for used in sorted(hypothesis.effects, key=lambda used: used is not first):
            effect = effect_in(used)
            for name in effect.excludes:
                if (name, effect.where) in hypothesis.keys:
                    return f"{effect.name} and {name} exclude each other at one place"
            if problem := self.effect_problem(hypothesis, used, effect.key in may_be_at_bounds):
                whose = f"of {effect.name} at {place_in_words(effect.where)}: "
                return problem if used is first else whose + problem
        return negative_body(self.train_data.rig, hypothesis.fit, self.empty.fit)

    def effect_problem(
        self, hypothesis: Hypothesis, used: Used, may_be_at_bounds: bool = False
    ) -> str:
        """Return in words which number of one effect of a set is impossible ('' if none is)."""
        rig, effect, terms = self.train_data.rig, effect_in(used), hypothesis.fit.terms
        values = hypothesis.fit.parameters(rig)
        problem = effect.problem(rig, values, used.shape)
        problem = problem or effect.not_shown(rig, values, used.shape, terms, self._signals)
        return problem or ("" if may_be_at_bounds else effect.outside(rig, used.shape))

    def refined(
        self, effects: Sequence[Used], rival: Hypothesis | None = None,
        in_form: Collection[Used] = (),
    ) -> Hypothesis:  # fmt: skip
        """Return the exact fit of a set of effects, computed once for its names and places.

        The search of its shapes ends early where it promises no improvement on the set `rival`.
        The effects `in_form` keep their forms, which are searched once the set is chosen
        (`in_best_forms`).
        """
        if not effects:
            return self.empty
        key = keys_of(effects)
        if key not in self.fitted:
            rival_fit = None if rival is None else rival.fit
            fit = refine(self.train_data, (*self.base, *effects), rival_fit, in_form)
            self._progress(1.0)
            self.fitted[key] = self._hypothesis(fit.terms[len(self.base) :], fit)
            if in_form:
                self._in_form.add(key)
            else:
                self._in_form.discard(key)
        return self.fitted[key]

    def in_best_forms(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a fitted set with the forms searched that its effects have kept."""
        key = hypothesis.keys
        if key not in self._in_form:
            return hypothesis
        earlier = self.fitted.pop(key)
        again = self.refined(earlier.effects)
        spoilt = self.physical_problem(again) and not self.physical_problem(earlier)
        if spoilt or again.total > earlier.total:
            self.fitted[key] = earlier
        return self.fitted[key]

    def refined_anew(self, effects: Sequence[Used], rival: Hypothesis | None = None) -> Hypothesis:
        """Return the best exact fit of a set: the earlier one, or one that starts at these shapes.

        Otherwise a further effect could seem to remove what a local minimum has left.
        """
        earlier = self.refined(effects)
        if set(effects) != set(earlier.effects):
            del self.fitted[earlier.keys]
            if self.refined(effects, rival).total > earlier.total:
                self.fitted[earlier.keys] = earlier
        return self.fitted[earlier.keys]

    def refined_below(
        self, energy: float, effects: Sequence[Used], rival: Hypothesis
    ) -> Hypothesis:
        """Return the exact fit of a set whose shapes in `effects` leave `energy`, or less.

        It may replace `rival`. An earlier fit that leaves more ended in a local minimum and is
        repeated from these shapes.
        """
        in_rival = [used for used in effects if used in rival.effects]
        earlier = self.refined(effects, rival, in_rival)
        return earlier if earlier.fit.energy <= energy else self.refined_anew(effects, rival)

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
        physical = [o for o in (*among, *self.simpler_sets(among)) if not self.physical_problem(o)]
        if not physical:
            return self.empty

        def preferred(one: Hypothesis, other: Hypothesis) -> Hypothesis:
            return other if is_preferred(other, one, self.noise_band) else one

        best = min(physical, key=lambda o: o.total)
        best = functools.reduce(preferred, (o for o in physical if o.size == best.size), best)
        similar = [o for o in physical if o is best or is_preferred(o, best, self.noise_band)]
        least_size = min((sum(o.size), o.size[0]) for o in similar)
        return self.in_best_forms(
            functools.reduce(
                preferred, (o for o in similar if (sum(o.size), o.size[0]) == least_size)
            )
        )

    def simpler_sets(self, among: Sequence[Hypothesis]) -> list[Hypothesis]:
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

    def candidate_columns(
        self, data: RegressionData, columns: Sequence[VariantColumns], mask: Array | None = None
    ) -> linear_fit.CandidateColumns:
        """Return columns without what the data's own terms explain; `mask` (M,) as weights."""
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

    @functools.cached_property
    def _signals(self) -> list[Signals]:
        return signals_of(self.train_data)

    @functools.cached_property
    def acting_equations(self) -> dict[Key, set[str]]:
        """Equations in which each candidate has columns under the baseline."""
        out: dict[Key, set[str]] = {}
        for entry in self.columns:
            out.setdefault(entry.used.term.key, set()).update(entry.touched)
        return out

    def prune(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return the set without effects that are not needed or remove too little."""
        band = self.noise_band
        while len(hypothesis.effects) > 1:
            smaller = self.each(
                lambda sets, effects: sets.in_best_forms(sets.refined_anew(effects)),
                map(hypothesis.without, hypothesis.effects),
            )
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
