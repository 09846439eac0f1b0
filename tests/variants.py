"""Which variants of a test run each time, and which with `make study NAME=variants` alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def kept(cases: Iterable[Any], which: Iterable[int]) -> list[Any]:
    """Return the cases as parameters: those at the places `which` run each time, others are slow.

    A case of several parameters is a tuple.
    """
    places = set(which)
    return [case if place in places else _slow(case) for place, case in enumerate(cases)]


def every_second(cases: Iterable[Any]) -> list[Any]:
    """Return the cases as parameters: every second one runs each time, the others are slow."""
    cases = list(cases)
    return kept(cases, range(0, len(cases), 2))


def _slow(case: Any) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.slow)
