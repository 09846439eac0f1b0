"""All stages on a simulated bench: run, record, identify, validate, trace, report."""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.identify.result import to_json as identification_json
from analysis.report.identification.report import render_report
from analysis.report.page import write
from analysis.simulation.model import save_model
from analysis.simulation.validate import RecordValidation, validate
from analysis.simulation.validate import to_json as validation_json
from analysis.trace.engine import trace
from analysis.trace.result import to_json as trace_json
from analysis.workers.forked import Forked
from protocols.files.plan import Overrides
from rig.cli.execution.experiment_loop import HELD_OUT, PROTOCOL
from rig.cli.execution.protocol_run import ProtocolJob, run_protocol
from rig.cli.simulated.simulated_bench import read_truth, simulated_bench
from rig.cli.text.output import Countdown, Say, progress, write_json
from rig.cli.text.render import identification_text, parameter_table, validation_text
from rig.cli.text.reports import provenance, write_trace
from rig.model.records import Run
from rig.runs.store import load_run, refuse_occupied

VALIDATE = "validate"
RIG = "shinshu-2dof"
HIDDEN = "worn-seal"  # effects of the demo's bench, unknown to the analysis


@dataclass(frozen=True)
class Experiment:
    """Runs of one simulated bench and their analysis; `truth` are the bench's true parameters.

    `held_out`: runs to judge a trace by, the last of them that of the validation.
    """

    run: Run
    held_out: tuple[Run, ...]
    identification: Identification
    validation: Sequence[RecordValidation]
    truth: Mapping[str, float]


def experiment(
    folder: Path, seed: int, overrides: Overrides, say: Say, scenario: str | None = None
) -> Experiment:
    """Run the demo's protocols on a simulated bench of `seed` into `folder`; analyse the runs.

    `scenario` (a bench's hidden effects) is passed to the bench alone; with one, a third run of
    another waveform and amplitude is taken as a hold-out for the trace.
    """
    refuse_occupied(folder)
    folder.mkdir(parents=True)
    truth = folder / "truth.json"
    say(f"starting the simulated bench {RIG}, seed {seed}")
    with simulated_bench(RIG, seed=seed, truth=truth, scenario=scenario) as endpoint:
        say(f"the simulated bench listens on {endpoint}")
        jobs = [
            ProtocolJob(PROTOCOL, RIG, folder / "identify", endpoint, overrides),
            ProtocolJob(VALIDATE, RIG, folder / "validate", endpoint),
        ]
        if scenario is not None:
            jobs.append(ProtocolJob(PROTOCOL, RIG, folder / "other-wave", endpoint, HELD_OUT))
        folders = [run_protocol(job, say) for job in jobs]
    run, validation_run, *others = map(load_run, folders)
    say("identifying the parameters from the first run")
    identification = identify([run])
    say("validating the model on the second run, which is held out")
    results = validate(identification.model, [validation_run])
    held_out = (*others, validation_run)
    return Experiment(run, held_out, identification, results, read_truth(truth))


def run_demo(out: Path, seed: int, repeats: int | None) -> None:
    """Run the demo into a new folder of `out`, print its results and write its reports."""
    started = time.monotonic()
    folder = out / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
    done = experiment(folder, seed, Overrides(repeats=repeats), progress, HIDDEN)
    write_json(folder / "identify.json", identification_json(done.identification))
    write_json(folder / "validate.json", validation_json(done.validation))
    progress("tracing missing effects, judged on held-out runs")
    traced = trace(
        [done.run], done.held_out, seed=seed, progress=Countdown("tracing"), pool=Forked()
    )
    write_json(folder / "trace.json", trace_json(traced))
    save_model(traced.model_after, folder / "model.json")
    command = f"bramah demo --out {shlex.quote(str(out))} --seed {seed}"
    page = render_report(
        runs=[done.run],
        identification=done.identification,
        validation=done.validation,
        validation_runs=done.held_out[-1:],
        truth=done.truth,
        title="A simulated bench, identified and validated",
        provenance=provenance(command, {"simulated bench": seed}),
    )
    write(folder / "report.html", page)
    write_trace(folder / "trace.html", done.held_out, traced)
    for name in ("report.html", "trace.html"):
        shutil.copyfile(folder / name, out / name)
    print(identification_text(done.identification, done.truth))
    print()
    print(validation_text(done.validation))
    print()
    print(f"trace: {traced.verdict}. {traced.sentence}")
    print()
    print("parameters, identified again with the effects found:")
    print(parameter_table(traced.model_after.parameters, done.truth))
    print()
    print(f"runs, model and results: {folder}")
    print(f"report: {out / 'report.html'}")
    print(f"trace: {out / 'trace.html'}")
    progress(f"the whole loop took {time.monotonic() - started:.0f} s")
