"""The figures of a report, in order, with captions; the page escapes the captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from analysis.identify.result import Identification
from analysis.report import format as fm
from analysis.report.identification.machine import steps
from analysis.report.identification.tables import joints_of
from analysis.report.plots import arm_plot, interval_plots, record_plots
from analysis.report.residuals import Residual
from analysis.report.settings import REPORT
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class ReportFigure:
    """A figure with its caption: heading and explanation, plain text."""

    svg: Markup
    heading: str
    text: str = ""


@dataclass(frozen=True)
class Gallery:
    """Figures of one kind, and the number left out."""

    figures: tuple[ReportFigure, ...]
    left_out: int = 0


def parameters(
    rig: Rig, identification: Identification, truth: Mapping[str, float] | None
) -> Gallery:
    """Return plots of the parameters against truth or nominal values, and of interval widths."""
    estimates = identification.estimates
    figures = []
    reference, kind = (truth, "truth") if truth else (rig.nominal, "nominal")
    if reference and any(name in reference for name in estimates):
        text = (
            "Zero is the value the simulated bench was built with." if truth
            else "Zero is the rig file's nominal value: a design value, not the truth."
        )  # fmt: skip
        figures.append(
            ReportFigure(interval_plots.against_reference(estimates, reference, kind),
                  f"Parameters against the {kind}", text)
        )  # fmt: skip
    figures.append(
        ReportFigure(interval_plots.interval_widths(estimates), "Width of the intervals",
              "They do not include effects that the model lacks: `bramah trace` looks for them.")
    )  # fmt: skip
    return Gallery(tuple(figures))


def arm(rig: Rig) -> ReportFigure | None:
    """Return the drawing of the arm; None for an electric one, which has no linkage to draw."""
    if rig.electric:
        return None
    return ReportFigure(
        arm_plot.arm(rig), "The arm, from its linkage",
        "Pistons at mid-stroke; dashed, each joint alone at either end of its stroke. Angles are "
        "relative to the link before, the first to the vertical below.",
    )  # fmt: skip


def excitations(rig: Rig, runs: Sequence[Run]) -> Gallery:
    """Return one figure per step and excited joint, of the step's first repeat."""
    draw = record_plots.electric_excitation if rig.electric else record_plots.excitation
    selected = [
        (step, joint) for step in steps(rig, runs) for joint in step.excited
        if ch.channel(rig.drive_kind, joint) in step.records[0].channels
    ]  # fmt: skip
    figures = [
        ReportFigure(
            draw(rig, step.records[0], joint, f"exc{n}"),
            f"{step.name}, joint {joint}",
            f"record {step.records[0].name}",
        )
        for n, (step, joint) in enumerate(selected[: REPORT.most_figures])
    ]
    return Gallery(tuple(figures), len(selected) - len(figures))


EQUATIONS = {
    "torque": "torque balance",
    "flow_cap": "flow into the cap side",
    "flow_rod": "flow into the rod side",
}


def residuals(all_residuals: Sequence[Residual]) -> Gallery:
    """Return one figure per step and equation."""
    figures = [
        ReportFigure(
            record_plots.residual(residual, f"res{n}"),
            f"{residual.step}, joint {residual.joint}: {equation_text(residual)}",
        )
        for n, residual in enumerate(all_residuals[: REPORT.most_figures])
    ]
    return Gallery(tuple(figures), len(all_residuals) - len(figures))


def equation_text(residual: Residual) -> str:
    """Return the name of a residual's equation in words."""
    return EQUATIONS[residual.equation.rsplit("_", 1)[0]]


def comparisons(rig: Rig, validation: Sequence[RecordValidation], runs: Sequence[Run]) -> Gallery:
    """Return measured against simulated for each kind of record and joint, first repeats only."""
    first_repeats: dict[str, tuple[RecordValidation, Record | None]] = {}
    for result, record in paired(validation, runs):
        first_repeats.setdefault(result.step, (result, record))
    selected = [
        (result, record, joint)
        for result, record in first_repeats.values() for joint in joints_of(result)
    ]  # fmt: skip
    figures = []
    for n, (result, record, joint) in enumerate(selected[: REPORT.most_figures]):
        window = record_plots.shown_part(result)
        seconds = (window.stop - window.start) / result.simulation.rate
        total = len(result.time) / result.simulation.rate
        text = f"last {seconds:.3g} s of {total:.3g} s, free run from the first sample"
        if window.start == 0:
            text = f"all {total:.3g} s, free run from the first sample"
        if result.failure:
            text += f"; {result.failure}"
        svg = record_plots.comparison(rig, result, record, joint, f"val{n}")
        figures.append(ReportFigure(svg, f"{result.record}, joint {joint}", text))
    return Gallery(tuple(figures), len(selected) - len(figures))


def paired(
    validation: Sequence[RecordValidation], runs: Sequence[Run]
) -> list[tuple[RecordValidation, Record | None]]:
    """Pair each validation with its record, by order if that fits, else by name."""
    records = [record for run in runs for record in run.records]
    if [r.name for r in records] == [v.record for v in validation]:
        return list(zip(validation, records, strict=True))
    by_name = {r.name: r for r in records}
    return [(v, by_name.get(v.record)) for v in validation]


def residual_rows(residuals: Sequence[Residual]) -> list[dict[str, Any]]:
    """Return the residual table as text, in N m or mL/s."""
    out = []
    for residual in residuals:
        unit = fm.display_unit(residual.unit)
        share = 100 * residual.rms / residual.rms_side if residual.rms_side else float("nan")
        scatter = residual.scatter if residual.repeats > 1 else float("nan")
        repeatable = residual.repeatable if residual.repeats > 1 else float("nan")
        masked = 100 * residual.masked / (residual.rows + residual.masked) if residual.masked else 0
        out.append(
            {
                "step": residual.step,
                "joint": residual.joint,
                "equation": equation_text(residual),
                "unit": unit.text,
                "side": fm.significant(residual.rms_side, scale=unit.scale),
                "rms": fm.significant(residual.rms, scale=unit.scale),
                "share": fm.percent(share),
                "repeatable": fm.significant(repeatable, scale=unit.scale),
                "scatter": fm.significant(scatter, scale=unit.scale),
                "rows": residual.rows,
                "masked": fm.percent(masked),
            }
        )
    return out


def largest_share(residuals: Sequence[Residual]) -> str:
    """Return the largest residual relative to its measured side, in words ('' without rows)."""
    shares = {
        (r.step, equation_text(r), r.joint): r.rms / r.rms_side for r in residuals if r.rms_side
    }
    if not shares:
        return ""
    step, equation, joint = max(shares, key=lambda key: shares[key])
    value = fm.percent(100 * float(np.max(list(shares.values()))))
    return f"{value} % of the measured side ({equation}, joint {joint}, {step})"
