"""Tables of the validation and of the paper: FIT per record, Table III, Table IV."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.identify.result import Identification
from analysis.report import format as fm
from analysis.report import paper
from analysis.report.residuals import Scatter
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch

KINDS = (ch.PISTON, ch.CAP, ch.ROD)
ABOVE, BELOW, EQUAL = "▲", "▼", "="


@dataclass(frozen=True)
class Worst:
    """The lowest FIT [%], with its channel and record."""

    fit: float
    channel: str
    record: str


def worst_fit(validation: Sequence[RecordValidation]) -> Worst | None:
    """Return the lowest finite FIT of all records and channels, None where there is none."""
    fits = [
        Worst(value, name, result.record)
        for result in validation
        for name, value in result.fit.items()
        if math.isfinite(value)
    ]
    return min(fits, key=lambda w: w.fit, default=None)


def joints_of(result: RecordValidation) -> list[int]:
    """Return the 1-based joints that a validation compares."""
    return sorted({joint for name in result.fit if (joint := ch.kind_of(name)[1]) is not None})


def fit_rows(validation: Sequence[RecordValidation]) -> list[dict[str, Any]]:
    """Return the table of all validation records, one row for each joint of a record.

    FIT [%], RMSE and windowed RMSE [mm, kPa] are those of s, p_cap, p_rod.
    """
    out = []
    for result in validation:
        for joint in joints_of(result):
            names = [ch.channel(kind, joint) for kind in KINDS]
            scaled = tuple(zip(names, (1e3, 1e-3, 1e-3), strict=True))
            remark = f"failed: {result.failure}" if result.failure else ""
            if result.outside:
                remark += ("; " if remark else "") + (
                    f"{fm.count(result.outside, 'simulated sample')} outside [0, supply]"
                )
            out.append(
                {
                    "record": result.record,
                    "joint": joint,
                    "fit": [fm.fit(result.fit.get(n)) for n in names],
                    "rmse": [fm.significant(result.rmse.get(n), scale=s) for n, s in scaled],
                    "window": [
                        fm.significant(result.window_rmse.get(n), scale=s) for n, s in scaled
                    ],
                    "remark": remark,
                }
            )
    return out


@dataclass(frozen=True)
class FitTable:
    """The paper's Table IV: rows, number of cells compared, number above the paper's."""

    rows: tuple[dict[str, Any], ...]
    compared: int
    above: int


def table_iv(rig_name: str, validation: Sequence[RecordValidation]) -> FitTable:
    """Compare the FIT of records with the paper's columns of the same names.

    Repeats of a record are averaged; empty for another rig or without such records.
    """
    if rig_name != paper.RIG:
        return FitTable((), 0, 0)
    rows = []
    compared = above = 0
    for column in paper.TABLE_IV:
        results = [r for r in validation if r.step == column.step]
        if not results:
            continue
        cells = []
        for i, kind in enumerate(KINDS):
            name = ch.channel(kind, column.joint)
            fits = [r.fit[name] for r in results if name in r.fit]
            fit = float(np.mean(fits)) if fits else float("nan")
            printed = column.fit[i] if column.fit else None
            mark = "" if printed is None or math.isnan(fit) else mark_of(fit, printed)
            compared += bool(printed is not None)
            above += mark == ABOVE
            cells.append({"own": fm.fit(fit), "paper": fm.fit(printed), "mark": mark})
        rows.append(
            {
                "record": column.step,
                "joint": column.joint,
                "records": len(results),
                "cells": cells,
                "figure": column.figure,
            }
        )
    return FitTable(tuple(rows), compared, above)


def mark_of(value: float, printed: float) -> str:
    """Return a mark for a number above, below or equal to the other."""
    return EQUAL if value == printed else ABOVE if value > printed else BELOW


def table_iii(
    rig_name: str, identification: Identification, scatter: Mapping[str, Scatter]
) -> list[dict[str, Any]]:
    """Compare the parameters with the paper's Table III; empty for another rig."""
    if rig_name != paper.RIG:
        return []
    out = []
    for name, estimate in identification.estimates.items():
        printed = paper.TABLE_III.get(name)
        if printed is None:
            continue
        unit = fm.display_unit(estimate.unit)
        repeats = scatter.get(name)
        spread = (repeats.low, repeats.mean, repeats.high) if repeats else (None, None, None)
        deviation = 100 * (estimate.value / printed.mean - 1)
        mark = mark_of(repeats.rsd, printed.rsd) if repeats and math.isfinite(repeats.rsd) else ""
        out.append(
            {
                "name": name,
                "unit": unit.text,
                "coupled": fm.significant(estimate.value, 4, unit.scale),
                "repeats": [fm.significant(v, 4, unit.scale) for v in spread],  # min, mean, max
                "rsd": fm.column_percent(repeats.rsd if repeats else None),
                "rsd_mark": mark,
                "paper": _printed(printed, unit.scale, 0 if name == "b" else 2),
                "against": fm.column_percent(deviation, signed=True),  # coupled over their mean [%]
            }
        )
    return out


def _printed(printed: paper.PaperParameter, scale: float, places: int) -> tuple[str, ...]:
    """Write the paper's min, mean, max, RSD, PSO, GA, nominal with the decimals it prints."""

    return (
        *(fm.fixed(v, places, scale) for v in (printed.low, printed.mean, printed.high)),
        f"{printed.rsd:.2f}",
        *(fm.fixed(v, places, scale) for v in (printed.pso, printed.ga)),
        " to ".join(fm.fixed(v, places, scale) for v in printed.nominal) or fm.DASH,
    )  # fmt: skip
