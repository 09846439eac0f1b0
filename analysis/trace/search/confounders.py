"""Candidates that are easily confused with an effect, by mechanism and place."""

from __future__ import annotations

from typing import Final

from analysis.effects.base import Effect
from analysis.terms.base import Used

BENCH: Final = "bench"


def is_confusable(effect: Effect, used: Used) -> bool:
    """Return whether a candidate is easily confused with an effect of the set.

    It is another name of its mechanism at the same place, or, at its joint or of the bench, the
    same effect on another channel or chamber or one of its confounders.
    """
    own = used.term
    assert isinstance(own, Effect)
    same = effect.mechanism == own.mechanism and effect.where == own.where
    alike = effect.name in (own.name, *own.confounders) and act_at_one_joint(effect, own)
    return (same or alike) and not effect.free


def is_confounder(effect: Effect, own: Effect) -> bool:
    """Return whether an effect is a confounder of another one, at its joint or of the bench."""
    return effect.name in own.confounders and act_at_one_joint(effect, own)


def act_at_one_joint(effect: Effect, other: Effect) -> bool:
    """Return whether two effects are at the same joint, or one of them is of the bench."""
    return len({_joint(effect), _joint(other)} - {BENCH}) <= 1


def _joint(effect: Effect) -> str:
    """Return the part of an effect's place that names its joint, or the bench."""
    place = effect.where
    return BENCH if place.startswith(BENCH) else " ".join(place.split()[:2])
