"""The shortlist: sets of effects fitted exactly, found by the search on the board.

The board's columns are first-order; a set found there is refined exactly and, where something is
left, extended from a new board that has the set among its terms. Every set fitted on the way stays
on the list: the rivals of the winner come from it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms.base import Used
from analysis.trace import select
from analysis.trace.board import Board, Entry, entries
from analysis.trace.candidates import Variant, complexity
from analysis.trace.evidence import scene_rows
from analysis.trace.refine import Fit, fit, refine, table
from rig.model.rig import Rig

Array = NDArray[np.float64]
Key = tuple[str, str]
log = logging.getLogger(__name__)

SINGLES = 14  # refined exactly, best first
PAIRS = 6
NEAR = 0.25  # of the best gain: a single candidate with less is no rival
NEXT = 6  # extensions of a set that are refined exactly
DEEPEST = 3  # effects in a set found by extension


@dataclass(frozen=True)
class Listed:
    """A set of effects on the list: its exact fit and energy above noise by equation."""

    effects: tuple[Used, ...]
    fit: Fit
    excess: dict[str, float]
    size: tuple[int, int]

    @property
    def keys(self) -> frozenset[Key]:
        """Names and places of its effects."""
        return frozenset((u.term.name, u.term.where) for u in self.effects)

    @property
    def total(self) -> float:
        """All energy left above noise, not below zero in any equation."""
        return sum(max(0.0, e) for e in self.excess.values())


@dataclass(frozen=True)
class Limits:
    """Energy that counts as nothing, by equation, on a stage."""

    band: dict[str, float]

    @property
    def total(self) -> float:
        """The sum over equations."""
        return sum(self.band.values())


def parameter_values(rig: Rig, terms: Sequence[Used], beta: dict[str, float]) -> dict[str, float]:
    """Return parameters from the rows' coefficients (b from 1/b)."""
    out = {}
    for used in terms:
        for c in used.term.coefficients(rig):
            value = float(beta.get(c.parameter, np.nan))
            out[c.parameter] = 1.0 / value if c.reciprocal and value else value
    return out


def excess_of(stage: Board, left: Array, noise: float = 1.0) -> dict[str, float]:
    """Return the energy above noise that a residual (M,) has in each equation of a stage."""
    out: dict[str, float] = {}
    for segment in stage.segments:
        part = left[segment.where]
        found = float(part @ part) - noise * len(part)
        out[segment.equation] = out.get(segment.equation, 0.0) + found
    return out


def limits(stage: Board) -> Limits:
    """Return the band of every equation (`select.BAND` times the noise, and chance)."""
    band: dict[str, float] = {}
    rows: dict[str, int] = {}
    for s in stage.segments:
        count = s.where.stop - s.where.start
        band[s.equation] = band.get(s.equation, 0.0) + select.BAND**2 * s.repeats * count
        rows[s.equation] = rows.get(s.equation, 0) + count
    return Limits({e: max(v, 4 * np.sqrt(2 * rows[e])) for e, v in band.items()})


def within(excess: dict[str, float], limit: Limits) -> bool:
    """Tell whether nothing is left above the band in any equation."""
    return all(value <= limit.band[e] for e, value in excess.items())


class Shortlist:
    """Sets of effects on one stage, fitted exactly once each."""

    def __init__(self, stage: Board, effects: Sequence[Variant]) -> None:
        self.stage = stage
        self.base = tuple(stage.terms)
        self.variants = tuple(effects)
        self.limits = limits(stage)
        self.listed: dict[frozenset[Key], Listed] = {}
        self.empty = self._listed((), fit(stage, self.base))

    def _listed(self, effects: tuple[Used, ...], found: Fit) -> Listed:
        rig = self.stage.rig
        return Listed(effects, found, excess_of(self.stage, found.left), complexity(rig, effects))

    def physical(self, one: Listed) -> str:
        """Say why a set is not physical ('' if it is)."""
        rig = self.stage.rig
        values = parameter_values(rig, one.fit.terms, dict(one.fit.beta))
        for used in one.effects:
            assert isinstance(used.term, Effect)
            problem = used.term.problem(rig, values, used.shape) or used.term.outside(
                rig, used.shape
            )
            if problem:
                return problem
        return ""

    def exact(self, effects: Sequence[Used]) -> Listed:
        """Return the set refined exactly (once per set of names and places)."""
        key = frozenset((u.term.name, u.term.where) for u in effects)
        if key not in self.listed:
            found = refine(self.stage, (*self.base, *effects))
            self.listed[key] = self._listed(found.terms[len(self.base) :], found)
        return self.listed[key]

    def better(self, one: Listed, other: Listed) -> bool:
        """Tell whether `one` is to be preferred: much less left, or as little and simpler."""
        slack = select.CHANCE * max(1, abs(one.size[1] - other.size[1]))
        if one.size < other.size:
            return one.total <= max(select.AS_GOOD * other.total, other.total + slack)
        if one.size > other.size:
            return one.total < min(other.total / select.AS_GOOD, other.total - slack)
        return one.total < other.total

    def best(self, among: Sequence[Listed]) -> Listed:
        """Return the preferred of several physical sets."""
        allowed = [o for o in among if not self.physical(o)]
        if not allowed:
            return self.empty
        least = min(allowed, key=lambda o: o.total)
        near = [o for o in allowed if o is least or self.better(o, least)]
        return min(near, key=lambda o: (o.size[1], o.size[0], o.total))

    def run(self) -> Listed:
        """Search: singles and pairs from the first board, then extensions; returns the winner."""
        found = entries(self.stage, self.variants)
        field = self._field(found)
        r = self.stage.mean
        r = r - field.basis @ (field.basis.T @ r)
        self.field, self.projected = field, r
        singles = [self.exact(e) for e in self._singles(field, r)]
        now = self.prune(self.best([self.empty, *singles]))
        if within(now.excess, self.limits):
            return now
        if self.formed(now):
            return self.completed(now)
        pairs = [self.exact(e) for e in self._pairs(field, r, singles)]
        now = self.prune(self.best([self.empty, *singles, *pairs]))
        while not within(now.excess, self.limits) and len(now.effects) < DEEPEST:
            grown = self.prune(self.best([now, *self.extensions(now)]))
            if grown.keys == now.keys or grown.total > 0.9 * now.total:
                break
            now = grown
            if self.formed(now):
                return self.completed(now)
        return now

    def formed(self, one: Listed) -> bool:
        """Tell whether what is left may be the difference of form between effect and catalogue."""
        return all(self.negligible(e, left) for e, left in one.excess.items())

    def negligible(self, equation: str, left: float) -> bool:
        """Tell whether so much energy above noise may be left in an equation."""
        allowed = (select.LEFT / select.BAND) ** 2 * self.limits.band[equation]
        return left <= max(allowed, select.FORM * self.empty.excess[equation])

    def completed(self, now: Listed) -> Listed:
        """Add one more effect only if that leaves nothing but noise: else it fits a form."""
        if within(now.excess, self.limits) or len(now.effects) >= DEEPEST:
            return now
        more = [o for o in self.extensions(now) if within(o.excess, self.limits)]
        best = self.best(more) if more else now
        return best if best.effects and self.prune(best).keys == best.keys else now

    def _field(self, found: Sequence[Entry]) -> select.Field:
        rig = self.stage.rig
        values = parameter_values(rig, self.stage.terms, dict(self.stage.beta))

        def allowed(entry: Entry, coefficients: Array) -> bool:
            own = dict(zip(entry.names, map(float, coefficients), strict=True))
            low, high = select.PSEUDO
            if "" in own and not low <= own[""] <= high:
                return False
            for c in entry.variant.effect.coefficients(rig):
                own.setdefault(c.parameter, 0.0)
            return not entry.variant.effect.problem(rig, {**values, **own}, entry.variant.shape)

        def size(entry: Entry) -> int:
            return complexity(rig, [entry.variant.used])[1]

        return select.field(self.stage, found, size, allowed)

    def _singles(self, field: select.Field, r: Array) -> list[tuple[Used, ...]]:
        g = select.gains(field.K, field.columns.T @ r, field.groups, field.raw)
        out: dict[Key, tuple[Used, ...]] = {}
        least = NEAR * float(np.max(g, initial=0.0))
        for i in map(int, np.argsort(-g)):
            variant = field.entries[i].variant
            if (
                (g[i] > least or (g[i] > 0 and len(out) < 3))
                and variant.key not in out
                and len(out) < SINGLES
            ):
                out[variant.key] = (variant.used,)
        return list(out.values())

    def _pairs(
        self, field: select.Field, r: Array, singles: Sequence[Listed]
    ) -> list[tuple[Used, ...]]:
        chosen = select.search(field, r)
        out = [tuple(field.entries[m].variant.used for m in chosen.members[:DEEPEST])]
        out += [
            tuple(field.entries[m].variant.used for m in pair.members)
            for pair in select.best_pairs(field, r, PAIRS)
        ]
        return [effects for effects in out if len(effects) > 1]

    def extensions(self, now: Listed) -> list[Listed]:
        """Return sets with one more effect, found on a board that has the set in its model."""
        stage = rebased(self.stage, now.fit)
        taken = now.keys
        found = entries(stage, [v for v in self.variants if v.key not in taken])
        field = self._field_of(stage, found)
        r = now.fit.left - field.basis @ (field.basis.T @ now.fit.left)
        more = select.options(field, (), r, 1.0)
        out: list[Listed] = []
        seen: set[Key] = set()
        for trial in more:
            variant = field.entries[trial.members[0]].variant
            if variant.key not in seen and len(seen) < NEXT:
                seen.add(variant.key)
                out.append(self.exact((*now.effects, variant.used)))
        return out

    def _field_of(self, stage: Board, found: Sequence[Entry]) -> select.Field:
        keep, self.stage = self.stage, stage
        try:
            return self._field(found)
        finally:
            self.stage = keep

    def prune(self, one: Listed) -> Listed:
        """Drop effects without which about as little is left."""
        while len(one.effects) > 1:
            rest = [
                self.exact(tuple(u for u in one.effects if u is not used)) for used in one.effects
            ]
            rest = [o for o in rest if not self.physical(o)]
            simpler = [o for o in rest if self.better(o, one) or self.idle(o, one)]
            if not simpler:
                break
            one = min(simpler, key=lambda o: o.total)
        return one

    def idle(self, without: Listed, one: Listed) -> bool:
        """Tell whether the effect that `without` lacks takes too small a share away."""
        drop = without.total - one.total
        return drop < select.ADD_SHARE * without.total


def rebased(stage: Board, model: Fit) -> Board:
    """Return the stage with a fitted model in place of its own."""
    rows = table(stage, model.terms)
    built = []
    for scene, before in zip(stage.scenes, stage.rows, strict=True):
        now = scene_rows(stage.rig, model.terms, scene)
        kept = {}
        for equation, old in before.items():
            _, here, there = np.intersect1d(old.time, now[equation].time, return_indices=True)
            matrix = np.zeros((len(old.rhs), len(now[equation].names)))
            rhs = np.zeros(len(old.rhs))
            matrix[here], rhs[here] = now[equation].matrix[there], now[equation].rhs[there]
            kept[equation] = replace(now[equation], matrix=matrix, rhs=rhs, time=old.time)
        built.append(kept)
    return replace(
        stage, terms=model.terms, beta=dict(model.beta), names=rows.names, base=rows.matrix,
        rows=tuple(built),
    )  # fmt: skip
