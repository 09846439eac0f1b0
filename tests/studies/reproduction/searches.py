"""PSO and GA beside the coupled method on STEP1, and what each of them lost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from analysis.identify.result import Identification
from analysis.report import paper
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from tests.studies.pages import Picture, Section, Table
from tests.studies.reproduction.bench import Reproduction
from tests.studies.reproduction.page import DASH, KINDS, error, percent, scale_of, shown
from tests.studies.reproduction.search_plot import convergence


def searches(done: Reproduction) -> Section:
    """Show what PSO and GA found on STEP1, and how many candidates they lost."""
    found = {method: s.found for method, s in done.searches.items()}
    names = next(iter(found.values())).extra["search"]["bounds"]
    rows = [
        [
            name, scale_of(name)[2], shown(name, paper.TABLE_III[name].pso, 2),
            shown(name, paper.TABLE_III[name].ga, 2),
            *(c for f in found.values() for c in _searched(f, name, done.runs.truth)),
            shown(name, done.coupled.estimates[name].value),
            percent(error(done.coupled.estimates[name].value, done.runs.truth[name])),
        ]
        for name in names
    ]  # fmt: skip
    header = [
        "parameter", "unit", "paper PSO", "paper GA", "PSO here", "error %", "GA here", "error %",
        "coupled", "error %",
    ]  # fmt: skip
    return Section(
        "PSO and GA on STEP1",
        (
            f"At most {done.scale.evaluations} candidates each. The searches use STEP1 only, so "
            "eight parameters have no value, and none has an interval. A search determines "
            "combinations: gains, friction, inertia and gravity may change together with little "
            "change of the output over a short window, and at 1 Hz the output hardly depends on "
            "b.",
            Table("Parameters of STEP1", header, rows),
            _lost_table(found),
            _fit_table(done),
            Picture(
                "search.svg",
                str(convergence({m: f.extra["search"] for m, f in found.items()}, "search")),
                "Best error so far, and the share of each generation that lost its state",
            ),
        ),
    )


def _searched(found: Identification, name: str, truth: Mapping[str, float]) -> tuple[str, str]:
    value = found.estimates[name].value
    return shown(name, value), percent(error(value, truth[name]), 1)


def _lost_table(found: Mapping[str, Identification]) -> Table:
    data: dict[str, Mapping[str, Any]] = {m: f.extra["search"] for m, f in found.items()}

    def row(title: str, *cells: str) -> list[str]:
        return [title, *cells]

    fates = list(next(iter(data.values()))["lost"])
    rows = [
        row("candidates simulated", *(str(d["evaluations"]) for d in data.values())),
        *(row(f"lost: {fate}", *(str(d["lost"][fate]) for d in data.values())) for fate in fates),
        row("lost, share", *(f"{share(d):.1f} %" for d in data.values())),
        row(
            "lost in the first generation",
            *(f"{d['lost_first_generation']} of {d['generation_sizes'][0]}" for d in data.values()),
        ),
        row(
            "best relative output error",
            *(f"{d['error']:.3g}" for d in data.values()),
        ),
    ]
    return Table("Candidates without a valid state", ["", *(m.upper() for m in data)], rows)


def share(data: Mapping[str, Any]) -> float:
    """Return the share [%] of a search's candidates that lost their state."""
    return 100.0 * float(sum(data["lost"].values())) / float(data["evaluations"])


def _fit_table(done: Reproduction) -> Table:
    rows = []
    for step, label in (("step1_1hz", "1 Hz"), ("step1_3hz", "3 Hz")):
        theirs = paper.TABLE_IV_SEARCH if step == "step1_1hz" else {}
        own = next(c.fit for c in paper.TABLE_IV if c.step == step) or (math.nan,) * 3
        for kind, index in zip(KINDS, range(3), strict=True):
            name = ch.channel(kind, 2)
            rows.append(
                [
                    f"{name}, {label}", f"{own[index]:.1f}",
                    *(f"{theirs[m][index]:.1f}" if m in theirs else DASH for m in ("PSO", "GA")),
                    fit(done.validation, step, name),
                    *(fit(s.fits, step, name) for s in done.searches.values()),
                ]
            )  # fmt: skip
    header = [
        "channel", "paper coupled", "paper PSO", "paper GA", "coupled here", "PSO here", "GA here",
    ]  # fmt: skip
    return Table("Table IV on STEP1's new records, FIT %", header, rows)


def fit(results: Sequence[RecordValidation], step: str, name: str) -> str:
    """Write FIT of one channel of one step's record."""
    found = next(r for r in results if r.step == step)
    return f"{found.fit[name]:.1f}" + (" (failed)" if found.failure else "")
