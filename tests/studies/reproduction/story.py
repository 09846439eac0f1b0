"""`python -m tests.studies reproduce`: run it, print it, write the page and its JSON."""

from __future__ import annotations

import shlex
import time
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from analysis.identify.result import to_json as identification_json
from analysis.report import paper
from analysis.simulation.validate import to_json as validation_json
from rig.cli.text.output import progress, write_json
from tests.studies.pages import Section, text, write_page
from tests.studies.reproduction.bench import FULL, QUICK, RIG, Reproduction, reproduce
from tests.studies.reproduction.methods import METHODS, sequential, simultaneous, summary
from tests.studies.reproduction.page import conditioning, payload, table_iii, table_iv
from tests.studies.reproduction.searches import searches

TITLE = "The paper's experiment, reproduced"


def write_story(out: Path, seed: int, quick: bool, docs: Path | None, json: Path | None) -> None:
    """Reproduce into a new folder of `out`; print the tables, write page, figures and JSON."""
    started = time.monotonic()
    scale = QUICK if quick else FULL
    folder = out / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
    done = reproduce(folder, seed, scale, progress)
    sections = page(done, command(seed, quick, docs))
    pages = [folder / "reproduction.md", *([docs] if docs is not None else [])]
    for path in pages:
        write_page(path, TITLE, sections)
    data = as_dict(done)
    write_json(folder / "reproduction.json", data)
    write_json(json, data)
    if json != Path("-"):
        print(text(sections[1:]))
        print()
        print(f"runs, page and JSON: {folder}")
    for path in pages[1:]:
        progress(f"page: {path}")
    progress(f"the whole reproduction took {time.monotonic() - started:.0f} s")


def command(seed: int, quick: bool, docs: Path | None) -> str:
    """Return the command line that makes the page."""
    words = ["python", "-m", "tests.studies", "reproduce", "--seed", str(seed)]
    words += ["--quick"] if quick else []
    words += ["--docs", str(docs)] if docs is not None else []
    return shlex.join(words)


def page(done: Reproduction, line: str) -> list[Section]:
    """Return the whole page."""
    return [
        Section(
            "",
            (
                f"Sections IV and V of the paper on the simulated bench `{RIG}` (seed "
                f"{done.seed}), over the wire: one joint locked, the other driven by a 1 Hz sine, "
                f"{done.scale.repeats} repeats of 10 s of each step; new data at 1 and 3 Hz and "
                "with both joints at once; a payload; and the other methods. Every number on this "
                "page that is not the paper's was measured by the command that wrote it:",
                f"    {line}",
                "The bench's physics is written apart from the analysis (spool dynamics, laminar "
                "orifices, contact, pump and relief, quantised and multiplexed sensors with the "
                "noise that the rig file states). The machine has only viscous friction and no "
                "leakage; the page therefore evaluates the method alone.",
            ),
        ),
        METHODS,
        table_iii(done),
        conditioning(done),
        table_iv(done),
        payload(done),
        sequential(done),
        simultaneous(done),
        searches(done),
        summary(done),
    ]


def as_dict(done: Reproduction) -> dict[str, Any]:
    """Return everything as plain data, SI, the paper's numbers beside it."""
    return {
        "seed": done.seed,
        "scale": asdict(done.scale),
        "truth": dict(done.runs.truth),
        "paper": {
            "table_iii": {name: asdict(p) for name, p in paper.TABLE_III.items()},
            "table_iv": [asdict(cell) for cell in paper.TABLE_IV],
            "table_iv_search": {m: list(fit) for m, fit in paper.TABLE_IV_SEARCH.items()},
            "condition_number": {family: list(v) for family, v in paper.CONDITION.items()},
            "rows": dict(paper.ROWS),
            "solve_seconds": paper.SOLVE_SECONDS,
        },
        "coupled": identification_json(done.coupled),
        "experiments": asdict(done.each),
        "experiments_paper_filter": asdict(done.paper_each),
        "validation": validation_json(done.validation),
        "payload": {
            name: {**asdict(r), "change": r.change, "responds": r.responds}
            for name, r in done.payload.items()
        },
        "sequential": identification_json(done.sequential),
        "simultaneous": {
            name: {
                "identification": identification_json(one.found),
                "experiments": asdict(one.each),
            }
            for name, one in (
                ("default", done.simultaneous),
                ("paper_filter", done.paper_simultaneous),
            )
        },
        "searches": {
            method: {
                "identification": identification_json(s.found),
                "validation": validation_json(s.fits),
            }
            for method, s in done.searches.items()
        },
    }
