"""From a protocol's plan to what the analysis predicts from: the two packages do not meet."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.prediction_twin import PlannedStep
from protocols.model import CLOSED
from protocols.plan import Plan, StepPlan


def planned_steps(
    plan: Plan, biases: Mapping[str, Mapping[int, float]] | None = None
) -> list[PlannedStep]:
    """Return a plan's steps in device terms; `biases` [V] by step and 1-based joint, if known."""
    return [planned_step(step, (biases or {}).get(step.name, {})) for step in plan.steps]


def planned_step(step: StepPlan, biases: Mapping[int, float]) -> PlannedStep:
    """Return one step: waveforms repeated to the step's common period."""
    return PlannedStep(
        name=step.name,
        waves={e.joint: np.resize(e.wave.samples, step.period) for e in step.excite},
        lines=step.lines,
        held={k.joint: k.piston for k in step.locks if k.at != CLOSED},
        closed={k.joint: k.piston for k in step.locks if k.at == CLOSED},
        centres={e.joint: e.centre for e in step.excite},
        biases={joint - 1: bias for joint, bias in biases.items()},
        samples=step.record,
        repeats=step.repeats,
    )
