"""What would pass instead of a step that was refused."""

from __future__ import annotations

from dataclasses import replace

from protocols.design.check import Twin, check_step
from protocols.language.waveforms import Waveform
from protocols.steps.plans import StepPlan
from rig.model.parse import InputError
from rig.model.rig import Rig

SMALLER, TRIES = 0.9, 20


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


def passing_scale(step: StepPlan, rig: Rig, twin: Twin) -> float | None:
    """Return the largest factor tried by which a step's amplitudes keep every limit; None if none.

    Factors are 0.9, 0.81, ...: each is proved on the twin, nothing is extrapolated.
    """
    factor = 1.0
    for _ in range(TRIES):
        factor *= SMALLER
        try:
            found = check_step(resized(step, factor), rig, twin)
        except InputError:
            continue
        if all(line.ok for line in found.predictions if line.binding):
            return factor
    return None
