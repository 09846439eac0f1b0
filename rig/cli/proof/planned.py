"""Conversion between a protocol's plan and the steps that the analysis predicts from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.design.moves import Tone
from analysis.design.optimise import Design
from analysis.design.twin_records import TwinStep
from protocols.files.plan import Plan, mapped
from protocols.files.schema import Protocol
from protocols.language.waveforms import Waveform
from protocols.signals.lines import chosen_lines
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED
from protocols.steps.plans import StepPlan


def planned_steps(
    plan: Plan, biases: Mapping[str, Mapping[int, float]] | None = None
) -> list[TwinStep]:
    """Return a plan's steps for the twin; `biases` [V] by step and 1-based joint, if known."""
    return [planned_step(step, (biases or {}).get(step.name, {})) for step in plan.steps]


def planned_step(step: StepPlan, biases: Mapping[int, float]) -> TwinStep:
    """Return one step, its waveforms repeated to the step's common period."""
    return TwinStep(
        name=step.name,
        waves={e.joint: np.resize(e.wave.samples, step.period) for e in step.excite},
        lines=step.lines,
        held={k.joint: k.piston for k in step.locks if k.at != CLOSED},
        closed={k.joint: k.piston for k in step.locks if k.at == CLOSED},
        centres={e.joint: e.centre for e in step.excite},
        biases={joint - 1: bias for joint, bias in biases.items()},
        samples=step.record,
        repeats=step.repeats,
        yields={k.joint: k.tolerance for k in step.locks if k.at == CLOSED},
        offsets={e.joint: e.settings.centring.offset for e in step.excite},
        where=step.where,
    )


def empty_lines(plan: Plan) -> dict[tuple[str, int], tuple[int, ...]]:
    """Return the detection lines of each step and joint, at the step's common period."""
    return {
        (step.name, e.joint): tuple(
            k * (step.period // e.wave.period) for k in e.wave.detection_lines
        )
        for step in plan.steps
        for e in step.excite
    }


def designed_step(plan: Plan, planned: TwinStep, tones: Mapping[int, Tone]) -> Step:
    """Return a protocol's step with the designed spectral lines instead of its signals."""
    step = next(s for s in plan.steps if s.name == planned.name)
    source = next(s for s in plan.protocol.excitations if s.name == planned.name)
    excite = []
    for part in source.excite:
        tone = tones[part.joint - 1]
        wave = Waveform(planned.waves[part.joint - 1], tone.chosen, tone.empty)
        signal = chosen_lines(wave, plan.sample_rate / step.period)
        excite.append(part.model_copy(update={"signal": signal}))
    # A record of one or several common periods keeps that length.
    seconds = step.record / plan.sample_rate
    return source.model_copy(update={"excite": tuple(excite), "duration": seconds})


def designed_protocol(plan: Plan, design: Design, criterion: str) -> Protocol:
    """Return the plan's protocol with all its steps as designed."""
    better = {
        planned.name: designed_step(plan, planned, tones)
        for planned, tones in zip(design.steps, design.tones, strict=True)
    }
    steps = mapped(plan.protocol.steps, lambda step: better.get(step.name or "", step))
    update = {
        "name": f"{plan.protocol.name}-{criterion.lower().replace('_', '-')}",
        "description": f"{plan.protocol.description}; designed for {criterion}",
        "steps": steps,
    }
    return plan.protocol.model_copy(update=update)
