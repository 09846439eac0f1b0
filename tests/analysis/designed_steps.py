"""Three short lock-and-excite steps as the analysis sees a plan, made here by hand."""

from __future__ import annotations

import numpy as np

from analysis.design.twin_records import TwinStep

PERIOD = 2000  # samples
LINES = tuple(range(1, 18, 2))  # 0.5 to 8.5 Hz
# Volts of command each line; joint 1 carries the whole arm.
SIZES = {"step1": 0.16, "step2": 0.10, "step3": 0.07}


def steps(periods: int = 3, repeats: int = 4) -> list[TwinStep]:
    """Joint 2 behind a closed joint 1, then joint 1 with joint 2 at either end."""
    out = []
    for k, (name, size) in enumerate(SIZES.items()):
        rng = np.random.default_rng(10 + k)
        t = np.arange(PERIOD) / PERIOD
        phases = rng.uniform(0, 2 * np.pi, len(LINES))
        wave = size * np.cos(2 * np.pi * np.outer(t, LINES) + phases).sum(axis=1)
        joint = 1 if name == "step1" else 0
        ends = {"step1": {}, "step2": {1: -0.0375}, "step3": {1: 0.0375}}
        out.append(
            TwinStep(
                name=name,
                waves={joint: wave},
                lines=LINES,
                held=ends[name],
                closed={0: 0.0} if name == "step1" else {},
                centres={joint: 0.0},
                biases={},
                samples=periods * PERIOD,
                repeats=repeats,
                yields={0: 5e-3} if name == "step1" else {},
                offsets={joint: 2e-3},
            )
        )
    return out
