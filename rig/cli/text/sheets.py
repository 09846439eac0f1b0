"""Text of a protocol's check, as a test sheet, and of a proof, as a table of steps."""

from __future__ import annotations

from collections.abc import Sequence

from protocols.design.check_report import CheckReport, Moment, MotionPrediction
from protocols.design.proof import Proof, Verdicts
from protocols.files.plan import Plan
from rig.cli.text.output import clock_text, condition_text, table
from rig.model.units import LIMITS, display_unit

_BAR = 40  # width of the timeline [characters]
_PICTURE = 30  # width between the two limits [characters]


def _cells(step: str, line: MotionPrediction) -> list[str]:
    display = display_unit(line.unit, LIMITS)
    scale, unit = display.scale, display.text
    low, high, least, most, margin = (
        f"{scale * value:.3g}"
        for value in (line.low, line.high, line.allowed_low, line.allowed_high, line.margin)
    )
    verdict = "ok" if line.ok else ("REFUSED" if line.binding else "note")
    return [
        f"{step} {_place(line)} {line.quantity}",
        f"{low} .. {high}",
        f"{least} .. {most}",
        margin,
        unit,
        verdict,
    ]


def check_text(report: CheckReport) -> str:
    """Return one row per prediction of the twin, and the duration of the run."""
    rows = [_cells(step.step, line) for step in report.steps for line in step.predictions]
    header = ["step, place, quantity", "predicted", "allowed", "margin", "unit", ""]
    minutes = report.seconds / 60.0
    parts = [timeline_text(report.timeline)] if report.timeline else []
    if rows:
        parts += [table(header, rows), envelope_text(report)]
    parts.append(f"about {minutes:.1f} min of the device's time")
    return "\n\n".join(parts)


def plan_text(plan: Plan) -> str:
    """Return the steps of a plan in order, with their durations."""
    lines = [f"plan of {plan.protocol.name} on {plan.rig}:"]
    for number, part in enumerate(plan.sequence, start=1):
        lines.append(f"  {number:3d}. {part.name}: {part.title} (about {part.seconds:.0f} s)")
        lines += [f"         {inner.name}: {inner.title}" for inner in part.nested]
    longest = "" if plan.longest <= plan.seconds else f", at most {clock_text(plan.longest)}"
    lines.append(f"  {len(plan.records)} records, about {clock_text(plan.seconds)}{longest}")
    return "\n".join(lines)


def timeline_text(moments: Sequence[Moment]) -> str:
    """Return begin and duration of each step, with a bar on a time axis."""
    end = max((m.begins + m.seconds for m in moments), default=0.0) or 1.0
    rows = []
    for moment in moments:
        first = min(_BAR - 1, int(_BAR * moment.begins / end))
        last = max(first + 1, round(_BAR * (moment.begins + moment.seconds) / end))
        bar = " " * first + "#" * (last - first)
        most = f" (at most {moment.longest:.0f} s)" if moment.longest > moment.seconds else ""
        begins, text = clock_text(moment.begins), f"{moment.name}: {moment.title}"
        rows.append(f"{begins:>8}  {moment.seconds:6.0f} s  |{bar:<{_BAR}}|  {text}{most}")
    return "\n".join(["  begins      time", *rows])


def envelope_text(report: CheckReport) -> str:
    """Return each predicted range as a bar within its limits, and its margin in words.

    The part of a range due to the uncertainty of the twin's parameters is drawn lighter.
    """
    drawn = any(any(line.spread) for step in report.steps for line in step.predictions)
    of_twin = f", on {report.twin}; within its intervals ---" if drawn else ""
    lines = [f"limits  [  predicted range ==={of_twin}  ]"]
    for step in report.steps:
        lines.append(f"{step.step}:")
        lines += [
            f"  {_place(line):9} {line.quantity:34} {_picture(line)}  {margin_text(line)}"
            for line in step.predictions
        ]
    return "\n".join(lines)


def margin_text(line: MotionPrediction) -> str:
    """Return the distance of a prediction from its nearer limit, and the side."""
    display = display_unit(line.unit, LIMITS)
    scale, unit = display.scale, display.text
    below, above = line.low - line.allowed_low, line.allowed_high - line.high
    upper = line.joint is None or above <= below
    room = above if upper else below
    limit = scale * (line.allowed_high if upper else line.allowed_low)
    side = "upper" if upper else "lower"
    amount = f"{scale * abs(room):.3g} {unit}"
    where = f"the {side} limit, {limit:.3g} {unit}"
    if room >= 0.0:
        return f"stays {amount} inside {where}"
    kind = "PASSES" if line.binding else "would pass"
    return f"{kind} {where}, by {amount}"


def _picture(line: MotionPrediction) -> str:
    """Return the bar of a predicted range between the limits; `<` and `>` mark violations."""
    span = line.allowed_high - line.allowed_low
    below, above = line.spread
    edges = (line.low, line.low + below, line.high - above, line.high)
    ends = [(value - line.allowed_low) / span for value in edges]
    first, low, high, last = (min(_PICTURE - 1, max(0, int(_PICTURE * end))) for end in ends)
    bar = "." * first + "-" * (low - first) + "=" * (high - low + 1)
    bar += "-" * (last - high) + "." * (_PICTURE - 1 - last)
    low_end = "<" if ends[0] < 0.0 else "["
    right = ">" if ends[-1] > 1.0 else "]"
    return f"{low_end}{bar}{right}"


def _place(line: MotionPrediction) -> str:
    return "bench" if line.joint is None else f"joint {line.joint}"


def proof_text(proof: Proof) -> str:
    """Return one row per step (actions, rank and condition so far, reason), then the verdict."""
    families = list(proof.verdicts)
    rows = [
        [f"{r.step}: {r.description}", *(_so_far(r.verdicts, family) for family in families), r.why]
        for r in proof.reasons
    ]
    header = ["step", *(f"{family} rank, cond." for family in families), "why"]
    lines = [table(header, rows, left=header), ""]
    for family, verdict in proof.verdicts.items():
        size = len(verdict.names)
        if verdict.complete:
            lines.append(
                f"{family}: all {size} parameters are determined, condition number "
                f"{condition_text(verdict.condition)}"
            )
            continue
        lines.append(f"{family}: rank {verdict.rank} of {size}")
        lines.append(f"  not determined: {' '.join(verdict.undetermined)}")
        lines += [f"  determined: {part.text}" for part in verdict.base]
    lines += [f"would help: {step}" for step in proof.help]
    return "\n".join(lines)


def _so_far(verdicts: Verdicts, family: str) -> str:
    verdict = verdicts[family]
    condition = condition_text(verdict.condition) if verdict.complete else "—"
    return f"{verdict.rank} of {len(verdict.names)}, {condition}"
