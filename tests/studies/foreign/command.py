"""The studies `foreign` and `intervals`: trace and identify on benches of textbook physics."""

from __future__ import annotations

from dataclasses import asdict, astuple
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json
from tests.studies.estimators.command import ClusterOption, KeepOption, WorkersOption

if TYPE_CHECKING:
    from tests.studies.foreign.study import Job


def foreign(
    seed: Annotated[int, typer.Option(min=0, help="First seed.")] = 0,
    count: Annotated[int, typer.Option(min=1, help="Of benches.")] = 30,
    stride: Annotated[int, typer.Option(min=1, help="Between seeds: 2 takes odd or even.")] = 2,
    only: Annotated[str, typer.Option(help="Hide this effect alone, by name.")] = "",
    kind: Annotated[str, typer.Option(help="none, single, pair or outside; else drawn.")] = "",
    spool: Annotated[
        int | None, typer.Option(min=0, max=2, help="0 continuous, 1 or 2 held and lagging.")
    ] = None,
    better: Annotated[
        bool, typer.Option("--better", help="Measure each better as well, three ways.")
    ] = False,
    tolerances: Annotated[
        bool, typer.Option("--tolerances", help="Rig files are wrong within stated tolerances.")
    ] = False,
    workers: WorkersOption = 1,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
) -> None:
    """Hide effects in benches of textbook physics and count what the trace makes of them.

    Odd seeds are for tuning, even ones judge.

    Example: python -m tests.studies foreign --seed 2 --count 5
    """
    from tests.studies.foreign.study import (
        BETTER,
        Job,
        Outcome,
        line_of,
        loaded,
        perform,
        text,
        weakened,
    )
    from tests.studies.pool import Kept, performed

    def report(done: int, of: int, job: Job, found: Outcome | Exception) -> None:
        line = line_of(found) if isinstance(found, Outcome) else f"seed {job.seed}: {found}"
        progress(f"{done}/{of} {line}")

    kept = Kept(keep, _name, asdict, loaded) if keep else None
    work = [
        Job(seed + stride * k, only, kind, spool, how, tolerances)
        for k in range(count)
        for how in ("", *(BETTER if better else ()))
    ]
    found = dict(performed(work, perform, cluster or workers, report, kept))
    outcomes = [found[job] for job in work if job in found]
    write_json(json, [asdict(o) for o in outcomes])
    typer.echo(text(outcomes))
    if better:
        typer.echo(weakened(found))


def _name(job: Job) -> str:
    return " ".join(map(str, astuple(job))) + ".json"


def intervals(
    seed: Annotated[int, typer.Option(min=0, help="First seed.")] = 0,
    count: Annotated[int, typer.Option(min=1, help="Of benches.")] = 20,
    stride: Annotated[int, typer.Option(min=1, help="Between seeds: 2 takes odd or even.")] = 2,
    estimator: Annotated[str, typer.Option(help="As `bramah identify --estimator`.")] = "auto",
    workers: WorkersOption = 1,
    cluster: ClusterOption = None,
    json: JsonOption = None,
    keep: KeepOption = None,
) -> None:
    """Identify clean benches of textbook physics and count intervals that hold the truth.

    Example: python -m tests.studies intervals --seed 2 --count 5
    """
    from tests.studies.foreign.intervals import Covered, line_of, loaded, perform, text
    from tests.studies.pool import Kept, performed

    def report(done: int, of: int, job: tuple[int, str], found: Covered | Exception) -> None:
        line = f"seed {job[0]}: {found}" if isinstance(found, Exception) else line_of(found)
        progress(f"{done}/{of} {line}")

    kept = Kept(keep, lambda j: f"{j[0]} {j[1]}.json", asdict, loaded) if keep else None
    work = [(seed + stride * k, estimator) for k in range(count)]
    done = performed(work, perform, cluster or workers, report, kept)
    outcomes = sorted((o for _, o in done), key=lambda o: o.seed)
    write_json(json, [asdict(o) for o in outcomes])
    typer.echo(text(outcomes))


def register(app: typer.Typer) -> None:
    """Add the studies to the command line."""
    app.command()(foreign)
    app.command()(intervals)
