"""A check of a protocol as a test sheet, and a proof as a table of its steps."""

from __future__ import annotations

from protocols.design.check_report import CheckReport, MotionPrediction
from protocols.design.proof import Proof, Verdicts
from rig.cli.output import table
from rig.model.quantity import unit_map

_SHOWN = {"m": "mm", "Pa": "MPa", "Pa/s": "GPa/s", "m^3/s": "L/min"}


def _cells(step: str, line: MotionPrediction) -> list[str]:
    unit = _SHOWN.get(line.unit, line.unit)
    scale = 1.0 / unit_map(unit, line.unit)[0]
    place = "bench" if line.joint is None else f"joint {line.joint}"
    low, high, least, most, margin = (
        f"{scale * value:.3g}"
        for value in (line.low, line.high, line.allowed_low, line.allowed_high, line.margin)
    )
    verdict = "ok" if line.ok else ("REFUSED" if line.binding else "note")
    return [
        f"{step} {place} {line.quantity}",
        f"{low} .. {high}",
        f"{least} .. {most}",
        margin,
        unit,
        verdict,
    ]


def check_text(report: CheckReport) -> str:
    """Return one row per prediction of the twin, and how long the run will take."""
    rows = [_cells(step.step, line) for step in report.steps for line in step.predictions]
    header = ["step, place, quantity", "predicted", "allowed", "margin", "unit", ""]
    minutes = report.seconds / 60.0
    return f"{table(header, rows)}\n\nabout {minutes:.1f} min of the device's time"


def proof_text(proof: Proof) -> str:
    """Return one row per step (what it does, rank and condition so far, why), then the verdict."""
    families = list(proof.verdicts)
    rows = [
        [f"{r.step}: {r.told}", *(_so_far(r.verdicts, family) for family in families), r.why]
        for r in proof.reasons
    ]
    header = ["step", *(f"{family} rank, cond." for family in families), "why"]
    lines = [table(header, rows, left=header), ""]
    for family, verdict in proof.verdicts.items():
        size = len(verdict.names)
        if verdict.complete:
            lines.append(
                f"{family}: all {size} parameters are determined, condition number "
                f"{verdict.condition:.1f}"
            )
            continue
        lines.append(f"{family}: rank {verdict.rank} of {size}")
        lines.append(f"  not determined: {' '.join(verdict.lost)}")
        lines += [f"  determined: {part.text}" for part in verdict.base]
    lines += [f"would help: {step}" for step in proof.help]
    return "\n".join(lines)


def _so_far(verdicts: Verdicts, family: str) -> str:
    verdict = verdicts[family]
    condition = f"{verdict.condition:.1f}" if verdict.complete else "—"
    return f"{verdict.rank} of {len(verdict.names)}, {condition}"
