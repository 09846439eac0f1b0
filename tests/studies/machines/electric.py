"""The simulated electric arm on an unknown slope: one machine told in full, many as a table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.simulation.validate import RecordValidation, validate
from analysis.terms import with_effects
from analysis.terms.base import Used
from rig.cli.text.output import table
from rig.model.electric import INCLINATION
from rig.model.records import Run
from rig.model.rig import ElectricRig
from rig.runs.exchange.importer import import_records
from rig.runs.rigs import load_rig
from tests.studies.machines.electric_plant import Arm, draw_arm, records

RIG = "electric-2dof"
FRICTION = ("coulomb_friction",)
# How a table's columns come about: steps, effects, whether the base is taken to be level.
VARIANTS: dict[str, tuple[tuple[str, ...], tuple[str, ...], bool]] = {
    "level base": (("both",), FRICTION, True),
    "no dry friction": (("both",), (), False),
    "both at once": (("both",), FRICTION, False),
    "one at a time": (("one", "two"), FRICTION, False),
}


@dataclass(frozen=True)
class ArmStory:
    """One arm: what it is, its runs by step, what was found and how that predicts new motion."""

    arm: Arm
    runs: dict[str, Run]
    found: dict[str, Identification]
    judged: list[RecordValidation]


def electric_rig() -> ElectricRig:
    """Return the shipped arm's description."""
    rig = load_rig(RIG)
    assert isinstance(rig, ElectricRig)
    return rig


def arm_story(
    seed: int, slope: float | None, variants: Sequence[str] = tuple(VARIANTS)
) -> ArmStory:
    """Draw an arm, record it, identify it in every variant, judge the full one on new motion."""
    rig, rng = electric_rig(), np.random.default_rng(seed)
    arm = draw_arm(rng, slope)
    steps = {step for variant in variants for step in VARIANTS[variant][0]}
    order: tuple[str, ...] = ("both", "one", "two")
    runs = {s: records(rig, arm, rng, step=s) for s in order if s in steps}
    found = {}
    for variant in variants:
        chosen, effects, level = VARIANTS[variant]
        bench = rig.model_copy(update={"inclination": 0.0}) if level else rig
        taken = [replace(runs[step], rig=bench) for step in chosen]
        found[variant] = identify(taken, terms=[Used(t) for t in with_effects(bench, effects)])
    test = records(rig, arm, rng, repeats=1)
    return ArmStory(arm, runs, found, validate(found["both at once"].model, [test]))


@dataclass(frozen=True)
class SlopeTable:
    """Errors (seeds,) of each parameter by variant; relative, of the slope in rad."""

    seeds: tuple[int, ...]
    errors: dict[str, dict[str, list[float]]]


def survey(seeds: Sequence[int], progress: Callable[[str], None]) -> SlopeTable:
    """Repeat the story on unseen arms and slopes."""
    errors: dict[str, dict[str, list[float]]] = {variant: {} for variant in VARIANTS}
    for seed in seeds:
        progress(f"arm {seed}")
        story = arm_story(seed, None)
        truth = story.arm.truth()
        for variant, result in story.found.items():
            for name, estimate in result.estimates.items():
                off = estimate.value - truth[name]
                relative = off if name == INCLINATION else off / truth[name]
                errors[variant].setdefault(name, []).append(relative)
    return SlopeTable(tuple(seeds), errors)


def survey_text(found: SlopeTable) -> str:
    """Return root mean square errors, a row per parameter and a column per variant."""
    names = list(found.errors["both at once"])
    rows = []
    for name in names:
        row = [name]
        for variant in found.errors:
            errors = found.errors[variant].get(name)
            if errors is None:
                row.append("—")
                continue
            rms = math.sqrt(sum(e * e for e in errors) / len(errors))
            shown = f"{math.degrees(rms):.3f} deg" if name == INCLINATION else f"{100 * rms:.2f} %"
            row.append(shown)
        rows.append(row)
    return table(["rms error", *found.errors], rows)


def survey_json(found: SlopeTable) -> dict[str, Any]:
    """Return the errors as plain data."""
    return {"seeds": list(found.seeds), "errors": found.errors}


def write_records(story: ArmStory, folder: Path) -> Path:
    """Write CSV files, a manifest and the truth, and import them; returns the run folder."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"rig: {RIG}", "sample_rate: 1 kHz", "records:"]
    for run in story.runs.values():
        for record in run.records:
            file = f"{record.name}.csv"
            head = ",".join(record.channels)
            data = np.column_stack(list(record.channels.values()))
            np.savetxt(folder / file, data, delimiter=",", header=head, comments="", fmt="%.9g")
            lines.append(
                f"  - {{file: {file}, step: {record.step}, locked: {list(record.locked)}, "
                f"repeat: {record.repeat}, period: {record.period}}}"
            )
    (folder / "manifest.yaml").write_text("\n".join(lines) + "\n")
    (folder / "truth.json").write_text(json.dumps(story.arm.truth(), indent=1) + "\n")
    return import_records(folder / "manifest.yaml", folder / "run").path
