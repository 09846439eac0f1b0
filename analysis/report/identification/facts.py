"""The first part of the report: summary, headline figures, checks, parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.identify.checks import Check
from analysis.identify.result import Identification
from analysis.identify.settings import IDENTIFY
from analysis.report import format as fm
from analysis.report import paper
from analysis.report.identification.tables import FitTable, worst_fit
from analysis.report.plots.interval_plots import relative_half_width
from analysis.simulation.model import Estimate
from analysis.simulation.validate import RecordValidation
from analysis.terms import baseline_of
from rig.model.records import Record, Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class Tile:
    """One figure of the headline: the number, its label, its reference."""

    number: str
    label: str
    detail: str
    warn: bool = False


@dataclass(frozen=True)
class CheckLine:
    """All statements of one check, ok if all are: one not ok first, the others in `more`."""

    name: str
    ok: bool
    detail: str
    more: tuple[str, ...]


def check_lines(checks: Sequence[Check]) -> list[CheckLine]:
    """Group checks by name, those that are not ok first."""
    by_name: dict[str, list[Check]] = {}
    for check in checks:
        by_name.setdefault(check.name, []).append(check)
    out = []
    for name, members in by_name.items():
        ordered = sorted(members, key=lambda c: c.ok)
        failed = sum(not c.ok for c in members)
        detail = ordered[0].detail
        if len(members) > 1:
            detail += f" ({failed} of {len(members)} such statements are not ok)" if failed else ""
        more = tuple(f"{'ok' if c.ok else 'not ok'}: {c.detail}" for c in ordered[1:])
        out.append(CheckLine(name, not failed, detail, more))
    return sorted(out, key=lambda line: line.ok)


def truth_remark(rig: Rig, truth: Mapping[str, float] | None) -> str:
    """State which true parameters of a simulated bench contradict rigid bodies ('' if none).

    Rigid bodies have R_ij = l_i W_j.
    """
    remarks = []
    for i, j in itertools.combinations(range(1, len(rig.joints) + 1), 2):
        R, W = (truth or {}).get(f"R{i}{j}"), (truth or {}).get(f"W{j}")
        length = rig.joints[i - 1].link_length
        if R is not None and W and abs(R / W / length - 1) >= IDENTIFY.length_tolerance:
            remarks.append(
                f"R{i}{j}/W{j} = {fm.significant(R / W)} m for a link of {fm.significant(length)} m"
            )
    if not remarks:
        return ""
    return (
        f"The simulated bench's own truth has {'; '.join(remarks)}: there the check on link length "
        "describes the bench, not the identification."
    )


def records_of(runs: Sequence[Run]) -> list[Record]:
    """Return all records of the runs in their order."""
    return [record for run in runs for record in run.records]


def duration(records: Sequence[Record]) -> float:
    """Return the total duration of records [s]."""
    return sum(record.samples / record.sample_rate for record in records)


def minutes(seconds: float) -> str:
    """Write a duration in seconds below two minutes, else in minutes."""
    if seconds < 120:
        return f"{seconds:.3g} seconds"
    return f"{seconds / 60:.3g} minutes"


def shared_records(runs: Sequence[Run], others: Sequence[Run]) -> int:
    """Count records of `others` whose samples were also used in `runs`."""
    used = {_fingerprint(record) for record in records_of(runs)}
    return sum(_fingerprint(record) in used for record in records_of(others))


def _fingerprint(record: Record) -> tuple[tuple[str, bytes], ...]:
    return tuple(
        (name, np.ascontiguousarray(samples).tobytes())
        for name, samples in sorted(record.channels.items())
    )


def sentences(
    rig: Rig,
    runs: Sequence[Run],
    identification: Identification,
    validation: Sequence[RecordValidation],
    validation_runs: Sequence[Run],
    *,
    simulated: bool,
) -> list[str]:
    """Return a summary of the identification and its validation in sentences."""
    records = records_of(runs)
    joints = len(rig.joints)
    expected = [c.parameter for term in baseline_of(rig) for c in term.coefficients(rig)]
    kind = "electric joint" if rig.electric else "hydraulic joint"
    identified = [e for n, e in identification.estimates.items() if e.identified and n in expected]
    steps = len({(i, r.step) for i, run in enumerate(runs) for r in run.records})
    bench = "the simulated bench" if simulated else "the rig"
    first = (
        f"On {bench} {rig.name} ({fm.count(joints, kind)}), "
        f"{fm.count(len(records), 'record')} of {fm.count(steps, 'step')} were taken, "
        f"{minutes(duration(records))} of data; one {identification.method} solution "
        f"gives {len(identified)} of the {len(expected)} parameters of the model."
    )
    if not validation:
        return [first, "The model has not been validated: no validation records were given."]
    worst = worst_fit(validation)
    shared = shared_records(runs, validation_runs)
    usage = (
        "never used for the fit" if not shared
        else f"of which {shared} had also been used for the fit"
    )  # fmt: skip
    second = (
        f"Driven by the measured spool alone, the model was then compared with "
        f"{fm.count(len(validation), 'record')} {usage}"
    )
    if worst is None:
        return [first, f"{second}; no channel gave a FIT."]
    return [
        first,
        f"{second}; the worst FIT of any channel is {fm.fit(worst.fit)} % "
        f"({worst.channel} of {worst.record}).",
    ]


def tiles(
    identification: Identification,
    validation: Sequence[RecordValidation],
    truth: Mapping[str, float] | None,
    table4: FitTable,
) -> list[Tile]:
    """Return the headline's figures."""
    estimates = identification.estimates
    known = {n: e for n, e in estimates.items() if e.identified}
    out = [
        Tile(f"{len(known)} of {len(estimates)}", "parameters identified",
             "all of the model's" if len(known) == len(estimates) else "the rest is noted below",
             len(known) < len(estimates))
    ]  # fmt: skip
    widths = {n: w for n, e in known.items() if not math.isnan(w := relative_half_width(e))}
    if widths:
        name = max(widths, key=lambda n: widths[n])
        out.append(Tile(f"±{fm.percent(widths[name])} %", "widest 95 % interval", name))
    if truth:
        errors = {n: 100 * (e.value / truth[n] - 1) for n, e in known.items() if truth.get(n)}
        if errors:
            name = max(errors, key=lambda n: abs(errors[n]))
            inside = sum(covers(known[n], truth[n]) for n in errors)
            out.append(
                Tile(f"{fm.percent(errors[name], signed=True)} %", "largest error against truth",
                     f"{name}; {inside} of {len(errors)} intervals contain the truth")
            )  # fmt: skip
    worst = worst_fit(validation)
    if worst is not None:
        out.append(Tile(f"{fm.fit(worst.fit)} %", "worst FIT, free run",
                        f"{worst.channel}, {worst.record}"))  # fmt: skip
    failed = sum(bool(r.failure) for r in validation)
    if failed:
        out.append(Tile(str(failed), "free runs that failed", "see validation", True))
    if table4.compared:
        out.append(Tile(f"{table4.above} of {table4.compared}", "FIT cells above the paper",
                        "Table IV", table4.above < table4.compared))  # fmt: skip
    lines = check_lines(identification.checks)
    not_ok = sum(not line.ok for line in lines)
    ok = len(lines) - not_ok
    others = "the others are named below" if not_ok else "all of them"
    out.append(Tile(f"{ok} of {ok + not_ok}", "checks ok", others, bool(not_ok)))
    return out


def covers(estimate: Estimate, truth: float) -> bool:
    """Return whether the 95 % interval contains the truth."""
    return bool(estimate.ci95[0] <= truth <= estimate.ci95[1])


def parameter_rows(
    rig: Rig, identification: Identification, truth: Mapping[str, float] | None
) -> list[dict[str, str]]:
    """Return the parameter table; cells without a number hold a dash."""
    return [
        _parameter_row(rig, name, estimate, truth or {})
        for name, estimate in identification.estimates.items()
    ]


def _parameter_row(
    rig: Rig, name: str, estimate: Estimate, truth: Mapping[str, float]
) -> dict[str, str]:
    unit = fm.display_unit(estimate.unit)
    value = unit.scale * estimate.value
    low, high = (unit.scale * end for end in estimate.ci95)
    places = fm.decimals(value, 0.5 * (high - low))
    digits = 4 if unit.scale == 1e6 else 3
    true = truth.get(name)
    mean = paper.TABLE_III[name].mean if rig.name == paper.RIG and name in paper.TABLE_III else None
    shown = estimate.identified
    error = 100 * (estimate.value / true - 1) if true and shown else None
    has_interval = shown and math.isfinite(low)
    covered = ("yes" if covers(estimate, true) else "no") if true and has_interval else fm.DASH
    return {
        "name": name,
        "meaning": fm.meaning(name, len(rig.joints)),
        "value": fm.fixed(value, places) if shown else fm.DASH,
        "half": f"± {fm.half_width(0.5 * (high - low), places)}" if has_interval else "",
        "unit": unit.text,
        "interval": f"{fm.fixed(low, places)} … {fm.fixed(high, places)}"
        if has_interval
        else fm.DASH,
        "rsd": fm.column_percent(100 * estimate.std / abs(estimate.value)) if shown else fm.DASH,
        "nominal": fm.significant(rig.nominal.get(name), digits, unit.scale),
        "truth": fm.significant(true, digits, unit.scale),
        "error": fm.column_percent(error, signed=True),
        "covered": covered,
        "paper": fm.significant(mean, digits, unit.scale),
        "note": estimate.note if shown else f"not identifiable: {estimate.note or 'no value'}",
    }
