"""The studies `ablations`, `isolability` and `baselines` of the trace's answers."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json
from tests.studies.estimators.command import ClusterOption, KeepOption, WorkersOption

if TYPE_CHECKING:
    from tests.studies.pages import Section
    from tests.studies.trace.ablations import Answer
    from tests.studies.trace.baselines import MethodAnswer

PageOption = Annotated[Path | None, typer.Option("--docs", help="Also write the page here.")]


def ablations(
    seed: Annotated[int, typer.Option(min=0, help="First seed; even ones judge.")] = 9000,
    count: Annotated[int, typer.Option(min=1, help="Of benches.")] = 12,
    workers: WorkersOption = 1,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
    docs: PageOption = None,
) -> None:
    """Trace foreign benches with every rule and without each, and count changed answers.

    Example: python -m tests.studies ablations --count 2
    """
    from tests.studies.pool import Kept, performed
    from tests.studies.trace.ablations import (
        ALL,
        as_json,
        loaded,
        perform,
        sections,
        small_bench_section,
        small_benches,
    )

    def report(done: int, of: int, job: int, found: list[Answer] | Exception) -> None:
        if isinstance(found, Exception):
            progress(f"{done}/{of} seed {job}: no records ({found})")
            return
        base = next(a for a in found if a.rule == ALL)
        others = [a for a in found if a.differs(base)]
        seconds = sum(a.seconds for a in found)
        progress(
            f"{done}/{of} seed {job} {base.label}: {base.answer}; {len(others)} rules change it, "
            f"{seconds:.0f} s"
        )

    kept = Kept(keep, lambda job: f"{job}.json", as_json, loaded) if keep else None
    work = [seed + 2 * k for k in range(count)]
    done = performed(work, perform, cluster or workers, report, kept)
    found = dict(sorted(done, key=lambda pair: pair[0]))
    write_json(json, {str(k): as_json(v) for k, v in found.items()})
    page = sections(found, _command("ablations", {"--seed": seed, "--count": count}, docs))
    small = []
    for bench in small_benches():
        progress(f"{bench.rule.name}: {bench.asserted}")
        small.append(bench)
    page.insert(1, small_bench_section(small))
    _show("Answers of the trace without each of its rules", page, json, docs)


def isolability(
    seed: Annotated[int, typer.Option(min=0, help="Of the records.")] = 9000,
    docs: PageOption = None,
) -> None:
    """Compute which pairs of effects the shipped protocol can separate, from columns and noise.

    Example: python -m tests.studies isolability
    """
    from tests.studies.trace.isolability import isolability as matrix_of
    from tests.studies.trace.isolability import sections, shipped_run

    run = shipped_run(seed)
    page = sections(matrix_of(run), _command("isolability", {"--seed": seed}, docs), run)
    _show("Which effects an experiment can separate", page, None, docs)


def baselines(
    seed: Annotated[int, typer.Option(min=0, help="First seed; even ones judge.")] = 9000,
    count: Annotated[int, typer.Option(min=1, help="Of benches.")] = 12,
    workers: WorkersOption = 1,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
    docs: PageOption = None,
) -> None:
    """Compare the trace with stepwise and sparse regression on foreign benches.

    Example: python -m tests.studies baselines --count 2
    """
    from tests.studies.pool import Kept, performed
    from tests.studies.trace.baselines import as_json, loaded, perform, sections

    def report(done: int, of: int, job: int, found: list[MethodAnswer] | Exception) -> None:
        if isinstance(found, Exception):
            progress(f"{done}/{of} seed {job}: no records ({found})")
            return
        words = ", ".join(f"{a.method} {a.answer} {100 * a.taken:.0f} %" for a in found)
        progress(f"{done}/{of} seed {job} {found[0].label}: {words}")

    kept = Kept(keep, lambda job: f"{job}.json", as_json, loaded) if keep else None
    work = [seed + 2 * k for k in range(count)]
    done = performed(work, perform, cluster or workers, report, kept)
    found = dict(sorted(done, key=lambda pair: pair[0]))
    write_json(json, {str(k): as_json(v) for k, v in found.items()})
    _show("The trace compared with two plain methods", sections(found, _command(
        "baselines", {"--seed": seed, "--count": count}, docs)), json, docs)  # fmt: skip


def _command(name: str, options: dict[str, int], docs: Path | None) -> str:
    words = [word for option, value in options.items() for word in (option, str(value))]
    page = ["--docs", str(docs)] if docs is not None else []
    return shlex.join(["python", "-m", "tests.studies", name, *words, *page])


def _show(title: str, page: Sequence[Section], json: Path | None, docs: Path | None) -> None:
    """Write the page where asked, and show it on the screen."""
    from tests.studies import pages

    if docs is not None:
        pages.write_page(docs, title, page)
    if json != Path("-"):
        typer.echo(pages.text(page))


def register(app: typer.Typer) -> None:
    """Add these studies to the command line."""
    app.command()(ablations)
    app.command()(isolability)
    app.command()(baselines)
