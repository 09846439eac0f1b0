"""The `identify` verb: every parameter from all records of the runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options import JsonOption, ReportOption, RunsArgument, writable_file
from rig.cli.text.output import Countdown, printed_at_end, progress, write_json

if TYPE_CHECKING:
    from analysis.identify.result import Identification
    from analysis.regression.rows import Filtering
    from analysis.simulation.model import Estimate
    from analysis.terms.base import Used
    from analysis.trace.search.refinement import ShapeFit
    from rig.model.records import Record, Run


def load_runs(folders: Sequence[Path], partly: bool = True) -> list[Run]:
    """Load run folders, each once; report progress if it takes long.

    Raises InputError for the same run twice and, if `partly`, for runs that share a record.
    """
    from rig.runs.repeated import refuse_repeated
    from rig.runs.store import load_run

    refuse_repeated(folders, partly)
    countdown, loaded = Countdown("loading"), []
    for folder in folders:
        loaded.append(load_run(folder))
        countdown(len(loaded) / len(folders))
    return loaded


def _refuse_unstreamed(option: str, method: str, estimator: str | None, bootstrap: int) -> None:
    """Raise InputError for settings that need the rows of all records in memory."""
    from rig.model.parse import InputError

    for name, given, expected in (
        ("--method", method, "coupled"),
        ("--estimator", estimator or "plain", "plain"),
        ("--bootstrap", str(bootstrap), "0"),
    ):
        if given != expected:
            raise InputError(
                f"{name} {given} needs all rows in memory and cannot be used with {option}: "
                f"expected {name} {expected}, or no {option}"
            )


def _streamed(
    runs: Sequence[Path],
    filtering: Callable[[Record], Filtering],
    effects: Sequence[str],
    like: Path | None,
    cluster: str | None,
) -> Identification:
    from analysis.identify.streams.out_of_core import identify_folders
    from analysis.simulation.model import load_model
    from analysis.workers.cluster import DaskCluster
    from analysis.workers.pool import Serial
    from rig.runs.repeated import refuse_repeated

    refuse_repeated(runs)
    model = None if like is None else load_model(like)
    # The workers read the folders, which need not exist on this computer.
    with Serial() if cluster is None else DaskCluster(cluster) as pool:
        return identify_folders(
            [str(run) for run in runs], filtering=filtering, pool=pool, effects=effects,
            like=model, progress=Countdown("identifying"),
        )  # fmt: skip


def _terms(
    runs: Sequence[Run], effects: Sequence[str], like: Path | None
) -> tuple[Sequence[Used] | None, ShapeFit | None]:
    """Return the terms of the options, None for the rig file's, and the fit of unset shapes."""
    from analysis.simulation.model import terms_like
    from analysis.terms import with_effects
    from analysis.terms.base import Used

    if like is not None:
        return terms_like(like, {run.source: run.rig for run in runs}), None
    if not effects:
        return None, None
    from analysis.trace.search.refinement import fit_shapes  # loads scipy.optimize, slowly

    terms = [Used(term) for term in with_effects(runs[0].rig, effects)]
    shape_fit = fit_shapes(runs, terms)
    return (terms if shape_fit is None else shape_fit.terms), shape_fit


def _with_shapes(
    result: Identification, shape_fit: ShapeFit | None
) -> tuple[Identification, dict[str, Estimate]]:
    """Return the result and the shapes of its effects by name; most models have none.

    Shapes that were fitted have errors, which the returned model holds as well.
    """
    if shape_fit is None and not any(used.shape for used in result.model.terms):
        return result, {}
    from analysis.trace.search.refinement import shapes_in  # loads scipy.optimize, slowly

    shapes = shapes_in(result.model.rig, result.model.terms)
    if shape_fit is None:
        return result, shapes
    from analysis.trace.judge.inference import with_shape_errors

    model, fitted = with_shape_errors(shape_fit, result.model)
    return replace(result, model=model), shapes | fitted


def _shape_json(shape: Estimate) -> dict[str, Any]:
    """Return a shape as JSON data, with its error where it was found in the records."""
    from analysis.simulation.model import estimate_json

    shape_fit = math.isfinite(shape.std)
    return estimate_json(shape) if shape_fit else {"value": shape.value, "unit": shape.unit}


def identify(
    runs: RunsArgument,
    method: Annotated[
        str, typer.Option(help="coupled, sequential, simultaneous, pso or ga.")
    ] = "coupled",
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--with", help="Add an effect to the model: NAME (every joint) or 'NAME@joint 1'."
        ),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(help="Use the terms of this model file: its effects and their shapes."),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            help="ls, wls, iv, robust, output-error; auto: ls, or iv where noise in the "
            "regressors biases ls significantly; plain: least squares alone.  "
            "[default: auto; plain with --stream or --cluster]"
        ),
    ] = None,
    bootstrap: Annotated[
        int,
        typer.Option(
            min=0, help="Bootstrap draws of whole repeats for the intervals; 0: from their scatter."
        ),
    ] = 0,
    filtering: Annotated[
        str, typer.Option(help="Filter: default, moving-average (the paper's) or butterworth.")
    ] = "default",
    json: JsonOption = None,
    model: Annotated[
        Path | None, typer.Option(help="Write the model file here.", callback=writable_file)
    ] = None,
    report: ReportOption = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Compare with the true parameters in this file of `bramah sim --truth`."),
    ] = None,
    physical: Annotated[
        bool,
        typer.Option("--physical", help="Constrain the parameters to physically consistent ones."),
    ] = False,
    evaluations: Annotated[
        int, typer.Option(min=4, help="Number of candidates that pso or ga simulates.")
    ] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of pso, ga and the bootstrap.")] = 0,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream",
            help="Keep one record in memory at a time, for large runs; coupled and plain "
            "only (an --estimator's refinements need all rows in memory).",
        ),
    ] = False,
    cluster: Annotated[
        str | None,
        typer.Option(help="Stream on the workers of the Dask scheduler at tcp://HOST:PORT."),
    ] = None,
) -> None:
    """Identify every parameter from all records of the runs, by --method.

    Example: bramah identify runs/monday --json parameters.json --model model.json
    """
    import numpy as np

    from analysis.identify.identify import identify as identify_runs
    from analysis.identify.methods.search import SearchOptions
    from analysis.identify.result import to_json
    from analysis.regression.rows import FILTERINGS
    from rig.cli.proof.twin_choice import save_identified
    from rig.cli.simulated.simulated_bench import read_truth
    from rig.cli.text.render import identification_text, method_text, physical_text, shapes_text
    from rig.model.parse import InputError

    if filtering not in FILTERINGS:
        raise InputError(f"--filtering {filtering}: expected one of: {' '.join(FILTERINGS)}")
    filters = FILTERINGS[filtering]
    true_values = None if truth is None else read_truth(truth)
    if like is not None and effects:
        raise InputError("--like uses the terms of a model unchanged: expected no --with beside it")
    if stream or cluster is not None:
        _refuse_unstreamed("--cluster" if cluster else "--stream", method, estimator, bootstrap)
        result, shape_fit = _streamed(runs, filters, effects or (), like, cluster), None
    else:
        loaded = load_runs(runs)
        terms, shape_fit = _terms(loaded, effects or (), like)
        result = identify_runs(
            loaded,
            method,
            terms,
            filters,
            estimator=estimator or "auto",
            bootstrap=bootstrap,
            rng=np.random.default_rng(seed),
            search=SearchOptions(evaluations=evaluations),
            progress=Countdown("identifying"),
        )
    result, shapes = _with_shapes(result, shape_fit)
    document: dict[str, Any] = {}
    appendix = shapes_text(shapes) + method_text(result)
    if shapes:
        document["shapes"] = {name: _shape_json(shape) for name, shape in shapes.items()}
    if physical:
        from analysis.identify.physical import physical as projected
        from analysis.identify.physical import to_json as physical_json
        from analysis.identify.physical import with_physics

        projection = projected(result)
        result = with_physics(result, projection)
        document["physical"] = physical_json(projection)
        appendix += f"\n\n{physical_text(projection)}"
    with printed_at_end(json, lambda: identification_text(result, true_values) + appendix):
        if model is not None:
            save_identified(result.model, model, progress)
        write_json(json, {**to_json(result), **document})
        if report is not None:
            from rig.cli.text.reports import write_identification

            write_identification(report, load_runs(runs), result)
