"""Of sets with a free form, the one to judge first."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from analysis.trace.free_forms import _simplest_first

BAND = 100.0


def set_of(laws: int, energy: float, numbers: int) -> Any:
    """Return a set of `laws` mechanisms that leaves an energy above noise."""
    return SimpleNamespace(
        laws=set(range(laws)), keys=(laws, energy), size=(laws, numbers), total=energy
    )


def first(*sets: Any) -> Any:
    wide = SimpleNamespace(
        within_form_tolerance=lambda o: o.total < 5000.0, within_noise=lambda o: o.total <= BAND
    )
    return _simplest_first(cast(Any, wide), sets)[0]


def test_one_mechanism_within_its_form_error_is_judged_before_three_that_leave_less() -> None:
    """Edges that saturate were called a line, a sagging supply and a curve of the edges."""
    curve, three = set_of(1, 4000.0, 12), set_of(3, 800.0, 16)
    assert first(three, curve) is curve


def test_a_further_mechanism_that_leaves_only_noise_is_judged_first() -> None:
    curve, two = set_of(1, 4000.0, 12), set_of(2, 50.0, 13)
    assert first(curve, two) is two


def test_a_set_that_leaves_more_than_form_error_yields_to_a_larger_one() -> None:
    curve, two = set_of(1, 9000.0, 12), set_of(2, 800.0, 13)
    assert first(curve, two) is two
