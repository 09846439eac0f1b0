"""Predicted errors of a protocol's estimates from its plan, for the verbs `check` and `design`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analysis.design.lateness import LatenessCost
from analysis.design.moves import Tone
from analysis.design.optimise import Design, improve
from analysis.design.predict import Prediction, predict, to_json
from analysis.design.settings import DESIGN
from analysis.design.twin_records import TwinStep
from drivers.registry import driver_class
from protocols.design.check import check
from protocols.design.check_report import CheckReport
from protocols.files import library
from protocols.files.plan import Plan, mapped, resolve
from protocols.files.schema import Protocol
from protocols.files.writer import protocol_text
from protocols.language.waveforms import Waveform
from protocols.signals.lines import chosen_lines
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED
from rig.cli.proof.twin_choice import TwinParameters
from rig.cli.text.output import condition_text, progress, table
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig

_ROUNDING = 1e-12  # below it a relative figure is a rounding error
CHECKED = 0.4  # share of the total time that the check of the limits takes


def planned_steps(
    plan: Plan, biases: Mapping[str, Mapping[int, float]] | None = None
) -> list[TwinStep]:
    """Return a plan's steps for the twin, waveforms repeated to the step's common period.

    `biases` [V] by step and 1-based joint, if known.
    """
    known = biases or {}
    return [
        TwinStep(
            name=step.name,
            waves={e.joint: np.resize(e.wave.samples, step.period) for e in step.excite},
            lines=step.lines,
            held={k.joint: k.piston for k in step.locks if k.at != CLOSED},
            closed={k.joint: k.piston for k in step.locks if k.at == CLOSED},
            centres={e.joint: e.centre for e in step.excite},
            biases={joint - 1: bias for joint, bias in known.get(step.name, {}).items()},
            samples=step.record,
            repeats=step.repeats,
            yields={k.joint: k.tolerance for k in step.locks if k.at == CLOSED},
            offsets={e.joint: e.settings.centring.offset for e in step.excite},
            where=step.where,
        )
        for step in plan.steps
    ]


def empty_lines(plan: Plan) -> dict[tuple[str, int], tuple[int, ...]]:
    """Return the numbers of the detection lines (not excited) by step and joint."""
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
    for stage in source.excite:
        tone = tones[stage.joint - 1]
        wave = Waveform(planned.waves[stage.joint - 1], tone.chosen, tone.empty)
        signal = chosen_lines(wave, plan.sample_rate / step.period)
        excite.append(stage.model_copy(update={"signal": signal}))
    # A record of one or several common periods keeps that length.
    seconds = step.record / plan.sample_rate
    return source.model_copy(update={"excite": tuple(excite), "duration": seconds})


def designed_protocol(plan: Plan, design: Design, criterion: str) -> Protocol:
    """Return the plan's protocol with all its steps as designed."""
    designed = {
        planned.name: designed_step(plan, planned, tones)
        for planned, tones in zip(design.steps, design.tones, strict=True)
    }
    steps = mapped(plan.protocol.steps, lambda step: designed.get(step.name or "", step))
    update = {
        "name": f"{plan.protocol.name}-{criterion.lower().replace('_', '-')}",
        "description": f"{plan.protocol.description}; designed for {criterion}",
        "steps": steps,
    }
    return plan.protocol.model_copy(update=update)


@dataclass(frozen=True)
class CheckedForecast:
    """Limits of a protocol on the twin, and its predicted errors; None for a `reason`.

    `wire` is that of the rig file, which may state the jitter of the samples' times.
    """

    limits: CheckReport
    prediction: Prediction | None
    reason: str = ""
    wire: Wire | None = None


def jitter_of(rig: Rig) -> float | None:
    """Return the standard deviation [s] of host-timed samples' times; None for a device's clock."""
    if not driver_class(rig.wire.kind).host_timed:
        return None
    return DESIGN.jitter if rig.wire.jitter is None else rig.wire.jitter


def _lateness_text(cost: LatenessCost, wire: Wire) -> str:
    """Return the effect of late samples on the estimate of b, and its assumption, in one line."""
    origin = (
        "assumed, since the rig file states no wire.jitter; `bramah probe` measures it"
        if wire.jitter is None
        else "wire.jitter"
    )
    missing = f", {percent(cost.missing)} % of them missing," if cost.missing else ""
    moved = (
        f"move b by {100 * cost.shift:+.3g} % and scatter it by {percent(cost.scatter)} %; its "
        "interval includes that"
        if math.isfinite(cost.shift)
        else "make b unidentifiable; lower the rig's sample_rate"
    )
    return (
        f"host-timed ({wire.kind}): samples {1e3 * cost.jitter:.3g} ms late ({origin}), "
        f"assigned to equidistant ticks{missing} {moved}"
    )


def of_plan(
    plan: Plan, parameters: TwinParameters, report: Callable[[float], None] | None = None
) -> CheckedForecast:
    """Check a plan's limits and predict its errors, or state why they cannot be predicted.

    Errors are predicted with the rig's nominal values, for the terms common to all models.
    """

    def stage(begin: float, end: float) -> Callable[[float], None] | None:
        return None if report is None else lambda share: report(begin + (end - begin) * share)

    rig = parameters.rig
    limits = check(plan, rig, parameters.twin, stage(0.0, CHECKED), parameters.draws)
    biases = {step.step: step.biases for step in limits.steps}
    if not plan.steps:
        return CheckedForecast(limits, None, "it takes no records of excited joints")
    try:
        steps = planned_steps(plan, biases)
        predicted = predict(rig, steps, jitter=jitter_of(rig), progress=stage(CHECKED, 1.0))
        return CheckedForecast(limits, predicted, wire=rig.wire)
    except InputError as error:
        return CheckedForecast(limits, None, str(error))


def prediction_json(forecast: CheckedForecast) -> dict[str, Any]:
    """Return the prediction, or the reason for its absence, as plain data."""
    if forecast.prediction is None:
        return {"impossible": forecast.reason}
    return to_json(forecast.prediction)


def percent(value: float) -> str:
    """Return a relative figure as a percentage with three digits, or a dash; rounding is zero."""
    shown = 100.0 * value if abs(value) > _ROUNDING else 0.0
    return f"{shown:.3g}" if math.isfinite(value) else "—"


def prediction_text(forecast: CheckedForecast) -> str:
    """Return predicted errors, conditioning and undetermined parameters as text."""
    p = forecast.prediction
    if p is None:
        return f"standard errors cannot be predicted: {forecast.reason}"
    rows = [
        [name, f"{e.nominal:.4g}", percent(e.std), percent(e.half), percent(e.oil)]
        for name, e in p.parameters.items()
    ]
    header = ["parameter", "value [SI]", "std. error %", "± 95 % %", "oil's swing %"]
    lines = ["predicted from the stated sensor noise, relative to the value on the twin:"]
    lines.append(table(header, rows))
    for family, (rank, size) in p.rank.items():
        condition = condition_text(p.condition[family])
        lines.append(f"{family}: rank {rank} of {size}, condition number {condition}")
    if p.masked_share > 0:
        lines.append(f"{100 * p.masked_share:.2g} % of the rows would be masked")
    lines += [f"NOT determined {n}: {e.note}" for n, e in p.parameters.items() if e.note]
    lines.append(f"worst known: {p.worst}")
    if p.lateness is not None and forecast.wire is not None:
        lines.append(_lateness_text(p.lateness, forecast.wire))
    return "\n".join(lines)


@dataclass(frozen=True)
class DesignedProtocol:
    """A designed protocol: its file's text, the design, and the predictions before and after."""

    text: str
    design: Design
    before: Prediction
    after: Prediction


def _checker(
    plan: Plan, parameters: TwinParameters
) -> Callable[[TwinStep, Mapping[int, Tone]], bool]:
    """Return the test of a step that `check` makes, with centring from zero bias."""

    def passes(planned: TwinStep, tones: Mapping[int, Tone]) -> bool:
        alone = {"steps": (designed_step(plan, planned, tones),)}
        try:
            trial = resolve(plan.protocol.model_copy(update=alone), parameters.rig)
            return check(trial, parameters.rig, parameters.twin, draws=parameters.draws).ok
        except InputError:
            return False

    return passes


def design_protocol(
    protocol: str, rig: str, criterion: str, budget: int, seed: int, parameters: TwinParameters
) -> DesignedProtocol:
    """Improve a protocol's multisines; raises InputError if that is impossible.

    Limits and errors are predicted on the twin of `parameters`.
    """
    bench = parameters.rig
    plan = resolve(library.load(protocol), bench)
    before = of_plan(plan, parameters)
    biases = {step.step: step.biases for step in before.limits.steps}
    design = improve(
        bench, planned_steps(plan, biases), empty_lines(plan), criterion, budget,
        np.random.default_rng(seed), progress, _checker(plan, parameters),
    )  # fmt: skip
    better = designed_protocol(plan, design, criterion)
    after = of_plan(resolve(better, bench), parameters)
    after.limits.require()
    assert before.prediction is not None  # the design needed the predictions, so they exist
    assert after.prediction is not None
    command = (
        f"bramah design {protocol} --rig {rig} --criterion {criterion} --budget {budget} "
        f"--seed {seed}"
    )
    text = protocol_text(better, f"Made by: {command}")
    return DesignedProtocol(text, design, before.prediction, after.prediction)


def design_text(designed: DesignedProtocol, out: Path | None) -> str:
    """Return the predicted errors before and after, and each step's share of its limits."""
    rows = []
    for name, e in designed.before.parameters.items():
        later = designed.after.parameters[name]
        ratio = f"{later.std / e.std:.2f}" if e.std > 0 else "—"
        rows.append([name, percent(e.std), percent(later.std), ratio])
    lines = [table(["parameter", "before %", "after %", "ratio"], rows), ""]
    for step, (share, limit) in designed.design.shares_after.items():
        old_share, old = designed.design.shares_before[step]
        lines.append(f"{limit} at {share:.0%} of its limit (before: {old} at {old_share:.0%})")
    written = "--out FILE writes it" if out is None else f"written to {out}"
    lines.append(
        f"trials: {designed.design.evaluated}, kept: {designed.design.accepted}; {written}"
    )
    return "\n".join(lines)


def design_json(designed: DesignedProtocol) -> dict[str, Any]:
    """Return predicted relative standard errors before and after, and the shares of limits."""
    after = designed.after.parameters
    return {
        "parameters": {
            name: {"before": e.std, "after": after[name].std}
            for name, e in designed.before.parameters.items()
        },
        "limits": {
            step: {"limit": limit, "share": share}
            for step, (share, limit) in designed.design.shares_after.items()
        },
        "tried": designed.design.evaluated,
        "kept": designed.design.accepted,
    }
