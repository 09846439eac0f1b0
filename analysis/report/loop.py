"""The loop's report: its rounds, predicted and achieved separation, and the last trace."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from analysis.report import format as fm
from analysis.report.identification.report import Provenance
from analysis.report.page import page
from analysis.report.plots import trace_plots
from analysis.report.plots.style import BLUE, CARD, GREY, INK, PALE, figure, note, style, svg
from analysis.report.trace import body
from analysis.trace.loop_rounds import Round
from rig.model import channels as ch
from rig.model.channels import place_in_words
from rig.model.records import Record, Run

TEMPLATE = "loop.html"


def render(
    train: Sequence[Run], holdout: Sequence[Run], rounds: Sequence[Round], stopped: str,
    provenance: Provenance | None = None,
) -> str:  # fmt: skip
    """Return the report as HTML text: `train[k]` are the records of round k."""
    last = rounds[-1]
    context = body(holdout, last.result, provenance)
    loop_context = {
        "stopped": stopped,
        "count": fm.count(len(rounds), "round"),
        "worth": separations(rounds),
        "rounds": [
            _round(r, train[k] if k < len(train) else None, r is last) for k, r in enumerate(rounds)
        ],
    }
    return page(TEMPLATE, {**context, **loop_context})


def _round(r: Round, run: Run | None, last: bool) -> dict[str, Any]:
    result = r.result
    following = result.next_experiment
    experiment = None if r.experiment is None else str(r.experiment["text"])
    return {
        "number": r.number,
        "verdict": result.verdict,
        "named": _names((e.name, e.at or e.where) for e in result.effects),
        "tied": _names(result.tied_at),
        "predicted": fm.significant(r.predicted),
        "achieved": fm.significant(r.achieved),
        "baseline_ratio": fm.significant(r.baseline_ratio),
        "left": fm.significant(r.residual),
        "did": "The protocol as given." if experiment is None
        else f"{experiment[:1].upper()}{experiment[1:]}.",
        "runs": " and ".join(r.runs),
        "sentence": result.sentence,
        "excitation": None if run is None or experiment is None else excited(run, r.number),
        # The last round has its own section below.
        "overview": None if last else trace_plots.over_noise(result, f"overnoise{r.number}"),
        "next": None if following is None else following["text"],
    }  # fmt: skip


def _names(effects: Any) -> str:
    return (
        ", ".join(f"{name.replace('_', ' ')} at {place_in_words(at)}" for name, at in effects)
        or fm.DASH
    )


def separations(rounds: Sequence[Round]) -> Markup | None:
    """Draw predicted and achieved separation of each experiment, and the error after each round."""
    if len(rounds) < 2:
        return None
    with style():
        canvas = figure(2.3, CARD * 2)
        axes = canvas.add_subplot(1, 2, 1)
        for r in rounds[1:]:
            if r.predicted is not None:
                axes.bar(r.number - 0.18, r.predicted, 0.32, color=PALE, edgecolor=GREY, lw=0.6)
            if r.achieved is not None:
                axes.bar(r.number + 0.18, r.achieved, 0.32, color=BLUE)
        axes.axhline(1.0, color=INK, lw=0.8, ls="--")
        axes.set_ylim(0.0, 1.2 * axes.get_ylim()[1])  # room for the labels
        axes.set_xticks([r.number for r in rounds[1:]])
        axes.set_xlim(1.4, len(rounds) + 0.6)
        axes.set_xlabel("round")
        axes.set_ylabel("separation over noise")
        note(axes, 0.02, 0.98, "pale predicted, blue achieved", INK, ha="left")
        axes = canvas.add_subplot(1, 2, 2)
        numbers = [r.number for r in rounds]
        without_effects = [r.result.worst(r.result.before) for r in rounds]
        axes.plot(numbers, without_effects, "o-", color=GREY)
        axes.plot(numbers, [r.residual for r in rounds], "o-", color=BLUE)
        axes.axhline(1.0, color=INK, lw=0.8, ls="--")
        axes.set_xticks(numbers)
        axes.set_ylim(0.0, 1.2 * axes.get_ylim()[1])
        axes.set_xlabel("round")
        axes.set_ylabel("worst held-out error over noise")
        note(axes, 0.98, 0.98, "grey without, blue with the effects found", INK)
        canvas.tight_layout()
        return svg(
            canvas, "worth", "Predicted and achieved separation of each experiment, by round"
        )


def excited(run: Run, number: int) -> Markup | None:
    """Draw the last period of each step: commands and the pistons' motion."""
    steps: dict[str, Record] = {}
    for record in run.records:
        steps.setdefault(record.step, record)
    if not steps:
        return None
    with style():
        canvas = figure(2.0, CARD * 2)
        for k, record in enumerate(steps.values(), start=1):
            axes = canvas.add_subplot(1, len(steps), k)
            moving = [j for j in range(1, len(run.rig.joints) + 1) if j not in record.locked]
            n = record.period or record.samples
            t = np.arange(n) / record.sample_rate
            for j, colour in zip(moving, (BLUE, INK, GREY), strict=False):
                piston = np.asarray(record.channels[ch.channel(ch.PISTON, j)])[-n:]
                axes.plot(t, 1e3 * piston, color=colour)
            axes.set_xlabel("time [s]")
            if k == 1:
                axes.set_ylabel("piston [mm]")
            note(axes, 0.98, 0.98, "joint " + " and ".join(map(str, moving)), INK)
        canvas.tight_layout()
        return svg(canvas, f"excited{number}", "Piston positions in a period of each step")
