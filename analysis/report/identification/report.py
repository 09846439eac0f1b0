"""The report of an identification: one self-contained HTML page with results and figures.

Every number is computed from the arguments. The page refers to nothing outside itself, needs no
script, and equal arguments result in equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from analysis.identify.result import Identification
from analysis.identify.stacked_rows import RecordRows, build_rows
from analysis.report import format as fm
from analysis.report import paper
from analysis.report.identification import facts, figures, machine, tables
from analysis.report.page import page
from analysis.report.residuals import per_repeat, residuals
from analysis.simulation.validate import RecordValidation
from rig.model.records import Run
from rig.model.rig import Rig

TEMPLATE = "report.html"


@dataclass(frozen=True)
class Provenance:
    """The origin of the report, as the caller states it: nothing here is read from the clock.

    `versions` maps a package to its version, `seeds` a purpose to its seed, `commands` are the
    lines that reproduce the report, `notes` free lines.
    """

    date: str = ""
    commands: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    seeds: Mapping[str, str | int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def render_report(
    *,
    runs: Sequence[Run],
    identification: Identification,
    validation: Sequence[RecordValidation] = (),
    validation_runs: Sequence[Run] = (),
    truth: Mapping[str, float] | None = None,
    title: str = "Identification report",
    provenance: Provenance | None = None,
) -> str:
    """Return the report as HTML text.

    `runs` are those behind `identification`, `truth` the parameters of a simulated bench (SI, by
    name). Raises InputError for records that cannot be used.
    """
    model = identification.model
    rig = model.rig
    rows = identification.built or build_rows(rig, runs, identification.model.terms)
    context = {
        "title": title,
        "rig": rig,
        "simulated": bool(truth),
        "provenance": provenance or Provenance(),
        "run_lines": _run_lines(runs, validation_runs),
        **_headline(rig, runs, identification, validation, validation_runs, truth),
        **_regression(identification, rows),
        **_bench(rig, runs, identification, truth),
        **_validated(rig, validation, validation_runs),
    }
    return page(TEMPLATE, context)


def _headline(
    rig: Rig,
    runs: Sequence[Run],
    identification: Identification,
    validation: Sequence[RecordValidation],
    validation_runs: Sequence[Run],
    truth: Mapping[str, float] | None,
) -> dict[str, Any]:
    table4 = tables.table_iv(rig.name, validation)
    return {
        "sentences": facts.sentences(
            rig, runs, identification, validation, validation_runs, simulated=bool(truth)
        ),
        "tiles": facts.tiles(identification, validation, truth, table4),
        "truth_remark": facts.truth_remark(rig, truth),
        "checks": facts.check_lines(identification.checks),
        "table4": table4,
        "table4_search": {
            name: tuple(fm.fit(v) for v in values) for name, values in paper.TABLE_IV_SEARCH.items()
        },
    }


def _regression(identification: Identification, rows: Sequence[RecordRows]) -> dict[str, Any]:
    residual_sets = residuals(identification, rows)
    scatter = per_repeat(identification, rows)
    rig = identification.model.rig
    return {
        "solutions": [
            {
                "family": family,
                "condition": fm.significant(solution.condition_number),
                "rows": f"{solution.rows}",
                "parameters": len(solution.names),
            }
            for family, solution in identification.solutions.items()
        ],
        "method": identification.method,
        "masked_rows": identification.masked_rows,
        "solve": fm.significant(1e3 * identification.solve_seconds),
        "paper": paper if rig.name == paper.RIG else None,
        "residual_rows": figures.residual_rows(residual_sets),
        "residual_figures": figures.residuals(residual_sets),
        "largest_share": figures.largest_share(residual_sets),
        "single": any(residual.repeats < 2 for residual in residual_sets),
        "table3": tables.table_iii(rig.name, identification, scatter),
        "repeats": max((s.repeats for s in scatter.values()), default=0),
    }


def _bench(
    rig: Rig,
    runs: Sequence[Run],
    identification: Identification,
    truth: Mapping[str, float] | None,
) -> dict[str, Any]:
    return {
        "parameters": facts.parameter_rows(rig, identification, truth),
        "parameter_figures": figures.parameters(rig, identification, truth),
        "has_paper": rig.name == paper.RIG,
        "arm": figures.arm(rig),
        "bench": machine.bench_constants(rig),
        "joints": machine.joint_constants(rig),
        "steps": machine.step_rows(rig, runs),
        "several_runs": len(runs) > 1,
        "excitation_figures": figures.excitations(rig, runs),
    }


def _validated(
    rig: Rig, validation: Sequence[RecordValidation], validation_runs: Sequence[Run]
) -> dict[str, Any]:
    return {
        "fit_rows": tables.fit_rows(validation),
        "fit_figures": figures.comparisons(rig, validation, validation_runs),
        "validation_steps": machine.step_rows(rig, validation_runs),
    }


def _run_lines(runs: Sequence[Run], validation_runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Name the run folders without their paths, because a report may be published."""
    return [
        {
            "name": fm.folder_name(run.source) or f"run {n}",
            "role": role,
            "state": run.state,
            "records": len(run.records),
        }
        for role, group in (("identification", runs), ("validation", validation_runs))
        for n, run in enumerate(group, start=1)
    ]
