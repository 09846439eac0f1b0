"""A smaller amplitude with which a refused step would pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from protocols.design.check import Twin, check_step
from protocols.language.waveforms import Waveform
from protocols.steps.plans import StepPlan
from rig.model.parse import InputError
from rig.model.rig import Rig

PERCENT = 100  # factors are tried in hundredths, so that the factor written is the one tried


def resized(step: StepPlan, factor: float) -> StepPlan:
    """Return a step with every waveform multiplied."""
    excite = tuple(
        replace(
            part,
            wave=Waveform(
                factor * part.wave.samples, part.wave.lines, part.wave.detection_lines
            ),
        )
        for part in step.excite
    )  # fmt: skip
    return replace(step, excite=excite)


def passing_scale(step: StepPlan, rig: Rig, twin: Twin, draws: Sequence[Twin]) -> float | None:
    """Return the largest factor found by which a step's amplitudes keep every limit; None if none.

    Found by bisection in hundredths below 1; the factor was proved on the twin and its `draws`.
    """
    passes, fails = 0, PERCENT
    while fails - passes > 1:
        trial = (passes + fails) // 2
        if _passes(resized(step, trial / PERCENT), rig, twin, draws):
            passes = trial
        else:
            fails = trial
    return passes / PERCENT if passes else None


def _passes(step: StepPlan, rig: Rig, twin: Twin, draws: Sequence[Twin]) -> bool:
    try:
        checked = check_step(step, rig, twin, draws)
    except InputError:
        return False
    return all(line.ok for line in checked.predictions if line.binding)
