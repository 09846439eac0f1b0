"""The `trace` verb: effects missing in the model, and the error without and with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from rig.cli.options import JsonOption, ReportOption, writable_file
from rig.cli.text.output import Countdown, printed_at_end, progress, write_json

FAMILIES_OF: Final = {
    "all": ("mechanical", "fluid"), "torque": ("mechanical",), "flow": ("fluid",),
}  # fmt: skip


def trace(
    runs: Annotated[list[Path], typer.Argument(help="Run folders used for the fit.")],
    holdout: Annotated[
        list[Path] | None,
        typer.Option("--holdout", help="A held-out run folder, not used for the fit; repeatable."),
    ] = None,
    judge: Annotated[
        list[Path] | None,
        typer.Option(
            "--judge", help="A run folder used only once, for the final judgement; repeatable."
        ),
    ] = None,
    json: JsonOption = None,
    model: Annotated[
        Path | None,
        typer.Option(help="Write the model file with the effects here.", callback=writable_file),
    ] = None,
    like: Annotated[
        Path | None, typer.Option(help="Start from this model file and take its effects as known.")
    ] = None,
    report: ReportOption = None,
    equations: Annotated[
        str, typer.Option(help="Equations to trace: all, torque or flow.")
    ] = "all",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sign-flip test.")] = 0,
) -> None:
    """Find effects that the model lacks: name, place, size, held-out error before and after.

    The verdict is clean, explained, confounded or unexplained; each verdict exits with 0.

    Example: bramah trace runs/monday --holdout runs/tuesday --report trace.html
    """
    from analysis.simulation.model import terms_like
    from analysis.trace.engine import trace as trace_runs
    from analysis.trace.result import to_json
    from analysis.workers.forked import Forked
    from rig.cli.proof.twin_choice import save_identified
    from rig.cli.text.trace_text import trace_text
    from rig.cli.verbs.identify import load_runs
    from rig.model.parse import InputError

    if not holdout:
        raise InputError(
            "trace needs --holdout RUN: records of another excitation, not used for the fit; an "
            "effect is named only if it also explains them"
        )
    if equations not in FAMILIES_OF:
        raise InputError(f"--equations {equations}: expected one of: {' '.join(FAMILIES_OF)}")
    families = FAMILIES_OF[equations]
    # The trace itself says which purpose a record serves twice.
    all_runs = load_runs([*runs, *holdout, *(judge or ())], partly=False)
    training, unseen = all_runs[: len(runs)], all_runs[len(runs) :]
    chosen_by, judged_by = unseen[: len(holdout)], unseen[len(holdout) :]
    rigs = {run.source: run.rig for run in all_runs}
    electric = [name for name, rig in rigs.items() if rig.electric]
    if electric and "mechanical" not in families:
        raise InputError(
            f"--equations {equations}: the rig of {electric[0]} is electric and has no flow "
            "equations; leave the option out"
        )
    known = None if like is None else terms_like(like, rigs)
    progress(f"tracing {sum(len(r.records) for r in training)} records")
    result = trace_runs(
        training, chosen_by, seed=seed, families=families, terms=known,
        progress=Countdown("tracing"), judge=judged_by, pool=Forked(),
    )  # fmt: skip
    with printed_at_end(json, lambda: trace_text(result)):
        write_json(json, to_json(result))
        if model is not None:
            save_identified(result.model_after, model, progress)
        if report is not None:
            from rig.cli.text.reports import write_trace

            write_trace(report, unseen, result)
