"""Free forms: mechanisms whose curve the data give, tried where no named effect explains."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.base import Effect
from analysis.trace.data.candidates import effect_in, effects_among
from analysis.trace.data.conditioned_record import families_of
from analysis.trace.finding import Finding, has_tied_rival, remainders
from analysis.trace.judge import gates
from analysis.trace.judge.curves import CurveRange
from analysis.trace.result import CONFOUNDED, EXPLAINED, UNEXPLAINED
from analysis.trace.search.extensions import extended_in, extensions
from analysis.trace.search.forward_search import completed_to_noise
from analysis.trace.search.hypothesis import (
    Hypothesis,
    act_at_one_joint,
    law_of,
    may_grow,
    removes_too_little,
)
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH

log = logging.getLogger(__name__)


def explained_by_free_form(
    finding: Finding, free: Sequence[Effect], rng: np.random.Generator
) -> Finding | None:
    """Return an explanation by the first set with a free form that gives one.

    Otherwise an `unexplained` finding that names the first set which explains every equation that
    it alters, and thus more equations than `finding` does. None where there is neither, and where
    none is needed: named effects explain to within the tolerance for their forms, with one
    mechanism or only noise left. A free form of the mechanisms `free` joins the named effects that
    passed, or replaces those of one mechanism; it never joins a name of its own mechanism at the
    same place. Every effect must pass every gate with it, no remainder may have a veto in an
    explanation, and no named effect may fit as well as the free form. Where the named effects
    explain, `_is_better` must hold too. `rng` draws the sign flips.
    """
    hypotheses, winner = finding.hypotheses, finding.winner
    explained = finding.verdict != UNEXPLAINED
    if not free or (explained and not (winner.effects and _may_be_replaced(hypotheses, winner))):
        return None
    extended = hypotheses.with_candidates(free)
    named = {kind.name for kind in extended.effects if not kind.free}
    unexplained = {r.equation for r in finding.remainders if r.veto and not explained}
    beside: Finding | None = None
    sets = _sets_with_free_form(extended, winner, explained)
    for hypothesis in map(extended.in_best_forms, _simplest_first(extended, sets)):
        within_range = CurveRange(finding.rows.choosing, hypothesis.fit).rows
        effects = gates.judge_effects(extended, hypothesis, within_range, rng)
        remaining = remainders(extended, hypothesis, within_range)
        failed = [(f.name, g.name, g.detail) for f in effects for g in f.gates if not g.ok]
        words = [r.words for r in remaining]
        log.info("free form %s: %s %s", sorted(hypothesis.keys), words, failed)
        ties = any(r.tied and r.name in named for f in effects if f.free for r in f.rivals)
        if ties or not all(map(gates.passes_gates, effects)):
            continue
        above = {r.equation for r in remaining if r.veto}
        if not above:
            verdict = CONFOUNDED if has_tied_rival(effects) else EXPLAINED
            return Finding(finding.rows, extended, hypothesis, verdict, effects, remaining)
        if beside is None and above < unexplained:
            judged = Finding(finding.rows, extended, hypothesis, UNEXPLAINED, effects, remaining)
            beside = _named_beside_unknown_cause(judged, above)
    return beside


def _may_be_replaced(hypotheses: HypothesisSet, winner: Hypothesis) -> bool:
    """Return whether a set that explains leaves enough for a free form in its place."""
    to_noise = hypotheses.within_noise(winner)
    several = len(winner.laws) > 1
    return not to_noise and (several or not _within_form_tolerance(hypotheses, winner))


def _within_form_tolerance(hypotheses: HypothesisSet, winner: Hypothesis) -> bool:
    """Return whether a set leaves no more than its forms may miss; exact effects miss nothing."""
    if all(effect.exact for effect in effects_among(winner.effects)):
        return hypotheses.within_noise(winner)
    return hypotheses.within_form_tolerance(winner)


def _sets_with_free_form(
    hypotheses: HypothesisSet, winner: Hypothesis, explained: bool
) -> list[Hypothesis]:
    """Return the physical sets with a free form that leave little enough (see the caller).

    Those that leave least are tried with a further effect too.
    """
    most = _most_mechanisms(hypotheses, winner) if explained else math.inf
    singles = [
        (start, single)
        for start in _sets_to_extend(hypotheses, winner, explained)
        if len(start.laws) < most
        for single in extensions(hypotheses, start, free=True, rival=winner)
        # An effect that removes so little would be needless beside a further one.
        if not removes_too_little(start, single, hypotheses.noise_band)
    ]
    singles.sort(key=lambda pair: pair[1].total)
    growing = [o.keys for _, o in singles if len(o.laws) < most][: SEARCH.free_forms_extended]
    out: list[Hypothesis] = []
    for start, single in singles:
        grows = single.keys in growing
        larger = [_with_further_effect(hypotheses, single, winner)] if grows else []
        for hypothesis in (single, *larger):
            explains = _explains_what_it_alters(hypotheses, start, hypothesis)
            better = not explained or _is_better(hypotheses, winner, hypothesis)
            if explains and better and not hypotheses.physical_problem(hypothesis):
                out.append(hypothesis)
    return [hypotheses.prune(o) for o in _simplest_first(hypotheses, out)]


def _most_mechanisms(hypotheses: HypothesisSet, winner: Hypothesis) -> int:
    """Return how many mechanisms a set may have that replaces one that explains by names alone.

    As many only where the names leave more than the tolerance for their forms: a level of friction
    that changes along the stroke misses what a curve follows.
    """
    return len(winner.laws) - _within_form_tolerance(hypotheses, winner)


def _is_better(hypotheses: HypothesisSet, winner: Hypothesis, hypothesis: Hypothesis) -> bool:
    """Return whether a set with a free form may replace one that explains by names alone.

    With fewer mechanisms it must leave at most `SEARCH.free_form_ratio` of the energy, with as many
    `SEARCH.free_form_ratio_alike`, and it may have no more than `_most_mechanisms`.
    """
    fewer = len(hypothesis.laws) < len(winner.laws)
    ratio = SEARCH.free_form_ratio if fewer else SEARCH.free_form_ratio_alike
    possible = len(hypothesis.laws) <= _most_mechanisms(hypotheses, winner)
    return possible and hypothesis.total < ratio * winner.total


def _named_beside_unknown_cause(finding: Finding, above: Collection[str]) -> Finding | None:
    """Return a finding whose effects pass the gates beside an unknown cause, None if one does not.

    The cause, in the equations `above` the band, must not lie where the effects act.
    """
    hypotheses, winner = finding.hypotheses, finding.winner
    effects = gates.judged_beside_unknown_cause(hypotheses, winner, finding.effects, above)
    outside = _altered(hypotheses.empty, winner).isdisjoint(above)
    named = outside and all(map(gates.passes_gates, effects))
    return replace(finding, effects=effects) if named else None


def _altered(start: Hypothesis, other: Hypothesis) -> set[str]:
    """Return the equations of which `other` removes a visible share of what `start` leaves."""
    before = start.excess_energy
    removed = {e: before[e] - v for e, v in other.excess_energy.items() if before[e] > 0.0}
    return {e for e, v in removed.items() if v >= SEARCH.altered_share * before[e]}


def _explains_what_it_alters(
    hypotheses: HypothesisSet, start: Hypothesis, other: Hypothesis
) -> bool:
    """Return whether the equations in which a set removes energy keep no more than form error.

    Held-out records judge the others, whose residual may be too small to refuse the set.
    """
    return all(hypotheses.negligible(e, other.excess_energy[e]) for e in _altered(start, other))


def _simplest_first(hypotheses: HypothesisSet, sets: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the sets to judge: those near the least energy first, the simplest of them first.

    Sets of more mechanisms than one within form error come last, unless they leave only noise: two
    pressure drops in series with a metering edge fit nearly any curve of that edge.
    """
    least = min((hypothesis.total for hypothesis in sets), default=0.0)
    energy_limit = SEARCH.free_form_near * least
    counts = (len(o.laws) for o in sets if hypotheses.within_form_tolerance(o))
    fewest = min(counts, default=len(sets))

    def needless(o: Hypothesis) -> bool:
        return len(o.laws) > fewest and not hypotheses.within_noise(o)

    ordered = sorted(sets, key=lambda o: (needless(o), o.total > energy_limit, o.size[1], o.total))
    return list({o.keys: o for o in ordered}.values())[: SEARCH.free_forms_judged]


def _with_further_effect(
    hypotheses: HypothesisSet, hypothesis: Hypothesis, winner: Hypothesis
) -> Hypothesis:
    """Return the set with one more effect for the equations above form error, if there is one.

    Where all are within form error, the effect must leave only noise. Two curves in one balance are
    no explanation: together they fit any residual in it.
    """
    energy = hypothesis.excess_energy
    above_form_error = {e for e, v in energy.items() if not hypotheses.negligible(e, v)}
    larger: Hypothesis | None = None
    if not above_form_error:
        larger = completed_to_noise(hypotheses, hypothesis)
    elif may_grow(hypothesis.effects):
        larger = extended_in(hypotheses, hypothesis, above_form_error, winner)
    return hypothesis if larger is None or _curves_share_a_balance(hypotheses, larger) else larger


def _curves_share_a_balance(hypotheses: HypothesisSet, hypothesis: Hypothesis) -> bool:
    """Return whether two free forms of a set act in the same family of rows of one joint."""
    curves = [e for e in effects_among(hypothesis.effects) if e.free]
    rig = hypotheses.train_data.rig
    return any(
        act_at_one_joint(a, b) and bool(families_of(rig, a) & families_of(rig, b))
        for a, b in itertools.combinations(curves, 2)
    )


def _sets_to_extend(
    hypotheses: HypothesisSet, winner: Hypothesis, explained: bool
) -> list[Hypothesis]:
    """Return the sets that a free form may join: the winner, and it without one mechanism.

    A free form is tried in place of a mechanism or of all, and beside all where the winner does not
    explain the records.
    """
    out = [hypotheses.empty] if explained else [hypotheses.empty, winner]
    for law in dict.fromkeys(map(law_of, effects_among(winner.effects))):
        other_effects = [u for u in winner.effects if law_of(effect_in(u)) != law]
        out.append(hypotheses.refined(other_effects))
    return list({o.keys: o for o in out}.values())
