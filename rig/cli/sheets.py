"""A check of a protocol as a test sheet: quantity, predicted, allowed, margin."""

from __future__ import annotations

from protocols.check_report import CheckReport, Prediction
from rig.cli.output import table
from rig.model.quantity import unit_map

_SHOWN = {"m": "mm", "Pa": "MPa", "Pa/s": "GPa/s", "m^3/s": "L/min"}


def _cells(step: str, line: Prediction) -> list[str]:
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
