"""Judgement of a set of effects: what passed the gates, the verdict, and what remains."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.trace.remaining import Remainder
from analysis.trace.result import JudgedEffect
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet


@dataclass(frozen=True)
class Judgement:
    """A set of effects after the gates.

    `effects` are all effects that were judged, refused ones included; `winner` is the set of those
    that passed; `remainders` are the equations in which it leaves too much; `hypotheses` are all
    sets that were fitted.
    """

    hypotheses: HypothesisSet
    effects: tuple[JudgedEffect, ...]
    winner: Hypothesis
    verdict: str
    remainders: tuple[Remainder, ...]


def has_tied_rival(effects: tuple[JudgedEffect, ...]) -> bool:
    """Return whether the records cannot separate one of the effects from a rival."""
    return any(rival.tied for effect in effects for rival in effect.rivals)
