"""The `study` verbs: what the method is worth, measured on hundreds of simulated experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json

WorkersOption = Annotated[int, typer.Option(min=1, help="Processes at once.")]
ClusterOption = Annotated[
    str | None,
    typer.Option(help="tcp://HOST:PORT of a Dask scheduler: its workers instead of processes."),
]
FirstSeed = Annotated[
    int, typer.Option("--first-seed", min=0, help="Those below 100 served to find errors.")
]
KeepOption = Annotated[
    Path | None,
    typer.Option(help="Keep what each experiment found here; a study begun again goes on from it."),
]
DocsOption = Annotated[
    Path | None, typer.Option(help="Also put the tables where this page has room for them.")
]


def coverage(
    experiments: Annotated[int, typer.Option(min=2, help="Of either kind.")] = 200,
    estimator: Annotated[str, typer.Option(help="As `bramah identify --estimator`.")] = "auto",
    kind: Annotated[str, typer.Option(help="model, plant, or both.")] = "both",
    noise: Annotated[float, typer.Option(min=0.0, help="Times the sensors' stated noise.")] = 1.0,
    repeats: Annotated[int, typer.Option(min=1, help="Of every step.")] = 4,
    first: FirstSeed = 100,
    workers: WorkersOption = 2,
    cluster: ClusterOption = None,
    keep: KeepOption = None,
    json: JsonOption = None,
    docs: DocsOption = None,
) -> None:
    """Count how often the 95 % intervals hold the truth, and how large the bias is.

    Example: python -m tests.studies coverage --experiments 200 --json coverage.json
    """
    from analysis.identify.estimation import refuse_unknown
    from tests.studies.estimators.tables import coverage_study, coverage_text
    from tests.studies.pages import replace_section

    _refuse_kind(kind, ("model", "plant", "both"))
    if estimator != "plain":
        refuse_unknown(estimator)
    kinds = ("model", "plant") if kind == "both" else (kind,)
    found = coverage_study(
        kinds, experiments, estimator, noise, repeats, cluster or workers, progress, first, keep
    )
    write_json(json, found)
    if docs is not None:
        for one in kinds:
            alone = {**found, "kinds": {one: found["kinds"][one]}}
            made = (
                f"python -m tests.studies coverage --kind {one} --experiments {experiments} "
                f"--estimator {estimator} --noise {noise:g} --repeats {repeats} "
                f"--first-seed {first} --docs {docs}"
            )
            replace_section(docs, f"study coverage {one}", in_section(made, coverage_text(alone)))
    if json != Path("-"):
        typer.echo(coverage_text(found))


def estimators(
    experiments: Annotated[int, typer.Option(min=2, help="Of either noise.")] = 20,
    noise: Annotated[str, typer.Option(help="Times the sensors' stated noise.")] = "1 3 10",
    which: Annotated[
        str, typer.Option(help="Estimators compared.")
    ] = "ls wls iv robust output-error auto",
    kind: Annotated[str, typer.Option(help="model or plant.")] = "plant",
    first: FirstSeed = 100,
    workers: WorkersOption = 2,
    cluster: ClusterOption = None,
    keep: KeepOption = None,
    json: JsonOption = None,
    docs: DocsOption = None,
) -> None:
    """Compare the estimators' bias, scatter and time as the sensors get noisier.

    Example: python -m tests.studies estimators --noise "1 10" --experiments 10
    """
    from analysis.identify.estimation import refuse_unknown
    from tests.studies.estimators.tables import estimator_study, estimator_text
    from tests.studies.pages import replace_section

    _refuse_kind(kind, ("model", "plant"))
    levels = [float(word) for word in noise.split()]
    every = tuple(which.split())
    for name in every:
        refuse_unknown(name)
    found = estimator_study(
        every, levels, experiments, kind, cluster or workers, progress, first, keep
    )
    write_json(json, found)
    if docs is not None:
        made = (
            f"python -m tests.studies estimators --kind {kind} --experiments {experiments} "
            f'--noise "{noise}" --which "{which}" --first-seed {first} --docs {docs}'
        )
        replace_section(docs, "study estimators", in_section(made, estimator_text(found)))
    if json != Path("-"):
        typer.echo(estimator_text(found))


def differentiation(
    seed: Annotated[int, typer.Option(min=0, help="Of excitation and noise.")] = 100,
    rig: Annotated[str, typer.Option(help="A shipped rig's name, or a file.")] = "shinshu-2dof",
    json: JsonOption = None,
) -> None:
    """Print bias and scatter of every parameter group for each way to differentiate.

    Example: python -m tests.studies differentiation
    """
    import numpy as np

    from rig.runs.rigs import load_rig
    from tests.studies.estimators.differentiation import as_json, markdown, table

    entries = table(load_rig(rig), np.random.default_rng(seed))
    data: list[dict[str, Any]] = as_json(entries)
    write_json(json, data)
    if json != Path("-"):
        typer.echo(markdown(entries))


def in_section(command: str, table: str) -> str:
    """Return what a page shows of a study: the command that makes it again, and its tables."""
    return f"```sh\n{command}\n```\n\n{table}"


def _refuse_kind(kind: str, known: tuple[str, ...]) -> None:
    from rig.model.parse import InputError

    if kind not in known:
        raise InputError(f"--kind {kind}: expected {', '.join(known[:-1])} or {known[-1]}")


def register(app: typer.Typer) -> None:
    """Add these studies to the command line."""
    for study in (coverage, estimators, differentiation):
        app.command()(study)
