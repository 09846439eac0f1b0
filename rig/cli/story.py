"""The whole loop on a simulated bench: start it, run, record, identify, validate, report."""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from analysis.identify import Identification, identify
from analysis.identify import to_json as identification_json
from analysis.model import save_model
from analysis.validate import RecordValidation, validate
from analysis.validate import to_json as validation_json
from protocols.plan import Overrides
from rig.cli.output import progress, write_json
from rig.cli.running import Job, run_protocol
from rig.cli.simulated import simulated_bench
from rig.cli.tables import identification_text, validation_text
from rig.cli.truth_file import read_truth
from rig.model.records import Run
from rig.services.store import load_run

IDENTIFY = "lock-and-excite-multisine"
VALIDATE = "validate"
RIG = "shinshu-2dof"
Say = Callable[[str], None]


@dataclass(frozen=True)
class Experiment:
    """Two runs of one simulated bench and what they say; `truth` is the bench's own."""

    runs: tuple[Run, ...]
    judged: tuple[Run, ...]
    identification: Identification
    validation: Sequence[RecordValidation]
    truth: Mapping[str, float]


def experiment(folder: Path, seed: int, overrides: Overrides, say: Say) -> Experiment:
    """Run the demo's protocols on a simulated bench of `seed` into `folder`, and analyse them."""
    folder.mkdir(parents=True)
    truth = folder / "truth.json"
    say(f"starting the simulated bench {RIG}, seed {seed}")
    with simulated_bench(RIG, seed=seed, truth=truth) as endpoint:
        say(f"it listens on {endpoint}")
        first = run_protocol(Job(IDENTIFY, RIG, folder / "identify", endpoint, overrides), say)
        second = run_protocol(Job(VALIDATE, RIG, folder / "validate", endpoint), say)
    runs, judged = (load_run(first),), (load_run(second),)
    say("identifying from the first run")
    found = identify(runs)
    say("validating on the second, which the fit has not seen")
    results = validate(found.model, judged)
    return Experiment(runs, judged, found, results, read_truth(truth))


def tell(out: Path, seed: int, repeats: int | None) -> None:
    """Run the demo into a new folder of `out`, print its results and write its report."""
    from rig.cli.reporting import write_experiment

    started = time.monotonic()
    folder = out / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
    done = experiment(folder, seed, Overrides(repeats=repeats), progress)
    write_json(folder / "identify.json", identification_json(done.identification))
    write_json(folder / "validate.json", validation_json(done.validation))
    save_model(done.identification.model, folder / "model.json")
    command = f"bramah demo --out {shlex.quote(str(out))} --seed {seed}"
    write_experiment(folder / "report.html", done, command, seed)
    shutil.copyfile(folder / "report.html", out / "report.html")
    print(identification_text(done.identification, done.truth))
    print()
    print(validation_text(done.validation))
    print()
    print(f"runs, model and results: {folder}")
    print(f"report: {out / 'report.html'}")
    progress(f"the whole loop took {time.monotonic() - started:.0f} s")
