"""The studies' experiments: plain functions of plain arguments, for any pool of processes."""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from analysis.estimators.coverage import Trial, trial
from analysis.identify import identify
from analysis.synthetic import multisine, synthetic_run
from rig.model.parse import InputError
from rig.model.records import Run
from rig.services.rigs import load_rig

JUDGING_SEED = 100  # seeds below served to find errors of the method; these and above judge
MODEL, PLANT = "model", "plant"
AMPLITUDE = 0.025  # [V] rms of spool on the model's own data, as the plant's protocol has


@dataclass(frozen=True)
class Experiment:
    """One simulated experiment: on the model itself or on the plant, and who estimates from it."""

    kind: str
    seed: int
    estimators: tuple[str, ...] = ("ls",)
    noise: float = 1.0
    repeats: int = 4
    rig: str = "shinshu-2dof"
    protocol: str = "lock-and-excite-multisine"


def records_of(experiment: Experiment) -> tuple[Run, dict[str, float]]:
    """Take an experiment's records; returns them with the truth."""
    rig = load_rig(experiment.rig)
    if experiment.kind == MODEL:
        rng = np.random.default_rng([experiment.seed, 7])
        wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
        run = synthetic_run(
            rig, rng, wave, rms=AMPLITUDE, repeats=experiment.repeats, noise=experiment.noise
        )
        return run, dict(rig.nominal)
    from hil_sim.scenario import Scenario
    from protocols.plan import Overrides
    from rig.cli.direct_bench import simulated_run

    scenario = Scenario(noise=experiment.noise)
    overrides = Overrides(repeats=experiment.repeats)
    return simulated_run(rig, experiment.protocol, experiment.seed, scenario, overrides)


def perform(experiment: Experiment) -> dict[str, Trial]:
    """Take the records and identify by every estimator asked for; returns trials by estimator.

    Parameters that rest on noise are judged as well: hiding them would flatter the figures.
    """
    began = time.process_time()
    run, truth = records_of(experiment)
    taking = time.process_time() - began
    out = {}
    for name in experiment.estimators:
        began = time.process_time()
        found = identify([run], estimator=name, reject_noise=False)
        out[name] = trial(found, truth, time.process_time() - began, taking)
    return out


def _place(experiment: Experiment, folder: Path) -> Path:
    e = experiment
    words = (e.kind, e.rig, e.protocol, "-".join(e.estimators), f"x{e.noise:g}", f"n{e.repeats}")
    return folder / f"{' '.join(words)} {e.seed}.json"


def _kept(experiment: Experiment, folder: Path) -> dict[str, Trial] | None:
    """Return what a study ended before its time had found, if it had."""
    place = _place(experiment, folder)
    if not place.is_file():
        return None
    return {name: Trial(**one) for name, one in json.loads(place.read_text("utf-8")).items()}


def end_with_parent() -> None:
    """See to it that this process does not outlive a study that was killed."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def all_of(
    experiments: Sequence[Experiment],
    workers: int,
    say: Callable[[str], None],
    job: Callable[[Experiment], dict[str, Trial]] = perform,
    folder: Path | None = None,
) -> Iterator[tuple[Experiment, dict[str, Trial]]]:
    """Perform experiments on `workers` processes, in the order they end.

    One that fails (a simulated bench whose piston would leave its limits) is told and left out.
    What is found is kept in `folder`, if given, and what is there already is not done again.
    """
    left = []
    for experiment in experiments:
        known = _kept(experiment, folder) if folder is not None else None
        if known is None:
            left.append(experiment)
        else:
            yield experiment, known
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        say(f"{len(experiments) - len(left)} of {len(experiments)} experiments are in {folder}")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=end_with_parent) as pool:
        waiting = {pool.submit(job, e): e for e in left}
        for done, future in enumerate(as_completed(waiting), start=1):
            if done % 10 == 0 or done == len(waiting):
                say(f"{done} of {len(waiting)} experiments")
            experiment = waiting[future]
            try:
                found = future.result()
                if folder is not None:
                    text = json.dumps({name: asdict(one) for name, one in found.items()})
                    _place(experiment, folder).write_text(text, encoding="utf-8")
                yield experiment, found
            except (InputError, RuntimeError) as error:
                say(f"seed {experiment.seed} failed and is left out: {error}")
