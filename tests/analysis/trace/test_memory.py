"""What the trace remembers of records: made once, and no more of it than allowed."""

from __future__ import annotations

import numpy as np

from analysis.trace.data.memory import Memory


def test_what_is_asked_for_again_is_not_made_again() -> None:
    memory, made = Memory(1e6), []
    for _ in range(3):
        memory.of("rows", lambda: made.append("rows") or {"torque_1": np.zeros(10)})
    assert made == ["rows"]


def test_the_oldest_goes_first() -> None:
    memory, made = Memory(2.5 * 80), []

    def asked(key: str) -> None:
        memory.of(key, lambda: made.append(key) or np.zeros(10))

    for key in "abacba":  # c pushes a out
        asked(key)
    assert made == ["a", "b", "c", "a"]
    assert memory.used <= memory.most
