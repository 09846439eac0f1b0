"""The `loop` verb: run, identify, trace, design and run the next experiment, repeatedly."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli import options as opt
from rig.cli.errors import code_and_message
from rig.cli.text.output import is_terminal, printed_at_end, progress, write_json

if TYPE_CHECKING:
    from rig.cli.execution.experiment_loop import Loop


def loop(
    rig: opt.RigOption,
    out: Annotated[
        Path, typer.Option(help="A folder for the runs and the report, made if needed.")
    ],
    endpoint: opt.EndpointOption = None,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Run designed experiments without asking.")
    ] = False,
    rounds: Annotated[int, typer.Option(min=0, help="Largest number of designed experiments.")] = 4,
    protocol: Annotated[
        str, typer.Option(help="Protocol of the first run: a shipped one or a file.")
    ] = "lock-and-excite-multisine",
    repeats: opt.RepeatsOption = None,
    amplitude_scale: opt.ScaleOption = 1.0,
    until_visible: Annotated[
        bool,
        typer.Option(
            "--until-visible",
            help="Continue after clean while a relevant effect could be below the noise.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the trace and of --simulate.")] = 0,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Start a simulated bench and use it.")
    ] = False,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario of --simulate, as for sim, such as random.")
    ] = None,
    json: opt.JsonOption = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="The report of all rounds.  [default: OUT/loop.html]", callback=opt.writable_file
        ),
    ] = None,
    operator: Annotated[
        str | None, typer.Option(help="Name written into the runs.  [default: the user]")
    ] = None,
) -> None:
    """Close the loop: run, trace, design the experiment that separates, run it, trace again.

    It stops when the remaining residual is noise, or no experiment predicts more than noise.

    Example: bramah loop --rig shinshu-2dof --out loops/monday --unattended
    """
    from rig.model.parse import InputError

    if simulate and endpoint is not None:
        raise InputError("--simulate starts a new bench: expected either --simulate or --endpoint")
    if scenario is not None and not simulate:
        raise InputError("--scenario needs --simulate: it cannot change a bench that runs already")
    if not unattended and not is_terminal(sys.stdin):
        raise InputError(
            "loop asks before each experiment that it designs; give --unattended where nobody "
            "can answer"
        )
    # The analysis loads slowly: options are checked before it is imported.
    from protocols.files.plan import Overrides
    from rig.cli.execution.experiment_loop import Loop, LoopRequest, refuse_used_folder
    from rig.cli.simulated.simulated_bench import simulated_bench

    refuse_used_folder(out)
    with ExitStack() as stack:
        if simulate:
            # The loop must not read the truth, so none is written.
            endpoint = stack.enter_context(simulated_bench(rig, seed=seed, scenario=scenario))
        ask = (lambda experiment: True) if unattended else _confirmed
        sizes = Overrides(repeats=repeats, amplitude_scale=amplitude_scale)
        page = report or out / "loop.html"

        def keep(loop: Loop) -> None:
            _write_result(loop, json, page)

        request = LoopRequest(
            rig, out, endpoint, protocol, sizes, rounds, seed, until_visible, operator, ask, keep
        )
        experiments = Loop(request, progress)
        try:
            experiments.run()
        except BaseException as error:
            experiments.stopped = code_and_message(error)[1]
            raise
        finally:
            _show_result(experiments, json, page, simulate)


def _confirmed(experiment: Mapping[str, Any]) -> bool:
    return typer.confirm(f"Run the next experiment ({experiment['text']})?", err=True)


def _write_result(experiments: Loop, json: Path | None, report: Path) -> None:
    """Write report, JSON and model of the rounds so far, each replaced as a whole."""
    from analysis.trace.loop_rounds import rounds_json
    from rig.cli.proof.twin_choice import write_identified
    from rig.cli.text.reports import write_loop

    out = experiments.request.out
    document = rounds_json(experiments.rounds, experiments.stopped)
    write_json(out / "loop.json", document)
    if json != Path("-") or experiments.stopped:
        write_json(json, document)
    if experiments.rounds:
        write_identified(experiments.rounds[-1].result.model_after, out / "model.json")
        write_loop(
            report, experiments.train, experiments.judge, experiments.rounds, experiments.stopped
        )


def _show_result(experiments: Loop, json: Path | None, report: Path, simulated: bool) -> None:
    """Write and print the result of a loop that has ended; its model becomes that of the bench.

    A simulated bench, which ends with the loop, keeps none.
    """
    from rig.cli.proof.twin_choice import save_identified
    from rig.cli.text.trace_text import rounds_text

    if not experiments.rounds:
        if experiments.request.out.is_dir():  # the loop did not end before its first record
            _write_result(experiments, json, report)
        return
    text = rounds_text(experiments.rounds, experiments.stopped)
    with printed_at_end(json, lambda: f"{text}\nreport: {report}"):
        _write_result(experiments, json, report)
        if not simulated:
            model = experiments.rounds[-1].result.model_after
            save_identified(model, experiments.request.out / "model.json", progress)
