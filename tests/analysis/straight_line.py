"""The smallest experiment: repeats of rows that a straight line is fitted to."""

from __future__ import annotations

import numpy as np

from analysis.identify.estimators.equations import RepeatBlock, segments


def line(rng: np.random.Generator, bend: float, repeats: int = 4) -> tuple[RepeatBlock, ...]:
    """Repeats of y = 2 x + bend x^3 + noise, which a straight line is fitted to."""
    t = np.arange(400) / 100.0
    x = np.sin(2 * np.pi * t / 4.0)
    parts = segments(t, 4.0)
    return tuple(
        RepeatBlock(0, "s", r, f"s_r{r}", "torque_1", x[:, None],
              2 * x + bend * x**3 + 0.1 * rng.standard_normal(400), t, parts, parts)
        for r in range(1, repeats + 1)
    )  # fmt: skip
