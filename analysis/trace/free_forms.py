"""Mechanisms without a name for their form: what is tried where no named effect explains."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from analysis.effects.base import Effect
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge import gates
from analysis.trace.judge.curves import within_curves
from analysis.trace.remaining import Rest, left_over
from analysis.trace.result import JudgedEffect
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH

log = logging.getLogger(__name__)


def drawn_by_data(
    hypotheses: HypothesisSet, free: Sequence[Effect], winner: Hypothesis,
    holdout_data: RegressionData, rng: np.random.Generator, fewer: bool = False,
) -> tuple[HypothesisSet, tuple[JudgedEffect, ...], Hypothesis, list[Rest]] | None:  # fmt: skip
    """Explain the records with a mechanism whose form the data draw; None where none does.

    Returns the sets tried, what was judged, the set that stands and what it leaves. `free` are the
    mechanisms, `winner` what stood of the named effects. A mechanism stands beside those effects,
    or in the place of readings of it. Every gate of every effect must hold with it, nothing may be
    left that speaks against it, and no named effect may fit as well: then what a name failed at is
    no matter of form. With `fewer` the named effects explain, within what their forms may miss, but
    need several mechanisms: what replaces them must need fewer and leave half as much.
    """
    if not free:
        return None
    wide = hypotheses.widened(free)
    tried: list[Hypothesis] = []
    for start in _starts(wide, winner, fewer):
        for single in wide.extensions(start, free=True):
            if wide.idle(start, single):  # it would be dropped beside a further effect
                continue
            hypothesis = single if wide.formed(single) else _with_more(wide, single)
            simpler = mechanisms(hypothesis) < mechanisms(winner)
            less = simpler and hypothesis.total < SEARCH.free_energy * winner.total
            if wide.formed(hypothesis) and not wide.physical(hypothesis) and (less or not fewer):
                tried.append(wide.prune(hypothesis))
    least = min((hypothesis.total for hypothesis in tried), default=0.0)
    first = sorted(
        tried,
        key=lambda hypothesis: (
            hypothesis.total > SEARCH.free_near * least,
            hypothesis.size[1],
            hypothesis.total,
        ),
    )
    for hypothesis in list({o.keys: o for o in first}.values())[: SEARCH.free_tried]:
        known = within_curves(holdout_data, hypothesis.fit)
        effects = gates.judge(wide, hypothesis, known, rng)
        rest = left_over(wide, hypothesis, known)
        failed = [(f.name, g.name, g.detail) for f in effects for g in f.gates if not g.ok]
        log.info("free form %s: %s %s", sorted(hypothesis.keys), [r.words for r in rest], failed)
        names = {kind.name for kind in wide.effects if not kind.free}
        named = any(r.tied and r.name in names for f in effects if f.free for r in f.rivals)
        if named or not all(map(gates.stands, effects)) or any(r.veto for r in rest):
            continue
        return wide, effects, hypothesis, rest
    return None


def _with_more(wide: HypothesisSet, hypothesis: Hypothesis) -> Hypothesis:
    """Return the set with one more effect where equations keep too much, else the set."""
    loud = {e for e, v in hypothesis.excess_energy.items() if not wide.negligible(e, v)}
    return (
        wide.closer(hypothesis, loud) if len(hypothesis.effects) < SEARCH.largest_set else None
    ) or hypothesis


def mechanisms(hypothesis: Hypothesis) -> int:
    """Count the mechanisms, each at its place, that a set of effects needs."""
    return len({(u.term.mechanism, u.term.where) for u in hypothesis.effects})  # type: ignore[attr-defined]


def _starts(wide: HypothesisSet, winner: Hypothesis, fewer: bool) -> list[Hypothesis]:
    """Return what a free mechanism may join: what stood, and without readings of one mechanism.

    Where it must need `fewer`, nothing: it is tried alone.
    """
    if fewer:
        return [wide.empty]
    out = {winner.keys: winner}
    for used in winner.effects:
        same = (used.term.mechanism, used.term.where)  # type: ignore[attr-defined]
        kept = [u for u in winner.effects if (u.term.mechanism, u.term.where) != same]  # type: ignore[attr-defined]
        start = wide.exact(kept) if kept else wide.empty
        out[start.keys] = start
    return list(out.values())
