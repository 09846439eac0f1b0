"""The studies `trace` and `distorted`: right names, wrong names and abstentions, counted."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json
from tests.studies.estimators.command import (
    ClusterOption,
    DocsOption,
    KeepOption,
    WorkersOption,
    in_section,
)


def trace(
    quick: Annotated[bool, typer.Option("--quick", help="A few cases of each kind.")] = False,
    clean: Annotated[int, typer.Option(min=0, help="Benches with nothing hidden.")] = 300,
    single: Annotated[int, typer.Option(min=0, help="Benches for each effect alone.")] = 3,
    pairs: Annotated[int, typer.Option(min=0, help="Benches with two effects.")] = 20,
    outside: Annotated[
        int, typer.Option(min=0, help="Benches with what the catalogue does not have.")
    ] = 12,
    machines: Annotated[
        int, typer.Option(min=0, help="Other machines, each with something drawn or nothing.")
    ] = 40,
    seed: Annotated[int, typer.Option(min=0, help="First seed; below 100 is for tuning.")] = 100,
    only: Annotated[str, typer.Option(help="Only these effects alone, by name.")] = "",
    level: Annotated[
        int | None, typer.Option(min=0, max=2, help="Only this size: 0 small .. 2 large.")
    ] = None,
    forms: Annotated[
        bool, typer.Option("--forms", help="Single effects in the bench's other forms only.")
    ] = False,
    workers: WorkersOption = 2,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
    docs: DocsOption = None,
) -> None:
    """Hide effects in simulated benches and count what the trace makes of them.

    Example: python -m tests.studies trace --quick
    """
    from tests.studies.trace.cases import NONE, OUTSIDE, PAIR, SINGLE, cases
    from tests.studies.trace.machines import cases_of
    from tests.studies.trace.study import all_of
    from tests.studies.trace.text import as_json, text

    names = tuple(only.split())
    counts = {NONE: clean, SINGLE: single, PAIR: pairs, OUTSIDE: outside}
    if quick:
        counts, machines = {NONE: 4, SINGLE: 1, PAIR: 1, OUTSIDE: 2}, 2
        names = names or ("coulomb_friction", "internal_leakage", "valve_deadband", "torque_offset")
    # Those that take long first: the last to end are then short ones.
    work = [*cases_of(machines, seed), *cases(counts, seed, names, level, forms)[::-1]]
    outcomes = list(all_of(work, cluster or workers, progress, keep))
    asked = {"--clean": clean, "--single": single, "--pairs": pairs, "--outside": outside,
             "--machines": machines}  # fmt: skip
    made = partial(command_of, asked, seed, quick=quick, only=only, level=level, forms=forms)
    write_json(json, as_json(outcomes))
    _show("study trace", text(outcomes), made, json, docs)


def distorted(
    count: Annotated[int, typer.Option(min=1, help="Of benches, faults in turn.")] = 22,
    seed: Annotated[int, typer.Option(min=0, help="First seed; below 100 is for tuning.")] = 100,
    workers: WorkersOption = 2,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
    docs: DocsOption = None,
) -> None:
    """Bend clean records as nothing in simulator or catalogue would, and count what is named.

    Example: python -m tests.studies distorted --count 11
    """
    from tests.studies.trace.distorted import cases_of
    from tests.studies.trace.study import all_of
    from tests.studies.trace.text import as_json, bent_text

    outcomes = list(all_of(cases_of(count, seed), cluster or workers, progress, keep))
    write_json(json, as_json(outcomes))

    def made(page: Path) -> str:
        options = {"--count": count, "--seed": seed, "--docs": page}
        words = [word for name, value in options.items() for word in (name, str(value))]
        return shlex.join(["python", "-m", "tests.studies", "distorted", *words])

    _show("study distorted", bent_text(outcomes), made, json, docs)


def _show(
    section: str, tables: str, made: Callable[[Path], str], json: Path | None, docs: Path | None
) -> None:
    """Put a study's tables on its page under the command that makes them, and on the screen."""
    from tests.studies.pages import replace_section

    if docs is not None:
        replace_section(docs, section, in_section(made(docs), f"```\n{tables}\n```"))
    if json != Path("-"):
        typer.echo(tables)


def command_of(
    counts: Mapping[str, int], seed: int, docs: Path, quick: bool = False, only: str = "",
    level: int | None = None, forms: bool = False,
) -> str:  # fmt: skip
    """Return the line that draws the same cases again: --quick has its own `counts`."""
    words = ["python", "-m", "tests.studies", "trace"]
    words += ["--quick"] if quick else [w for name, n in counts.items() for w in (name, str(n))]
    words += ["--seed", str(seed)]
    words += ["--only", only] if only else []
    words += [] if level is None else ["--level", str(level)]
    words += ["--forms"] if forms else []
    return shlex.join([*words, "--docs", str(docs)])


def register(app: typer.Typer) -> None:
    """Add these studies to the command line."""
    app.command()(trace)
    app.command()(distorted)
