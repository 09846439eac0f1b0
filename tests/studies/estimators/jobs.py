"""The studies' experiments: plain functions of plain arguments, for any pool of processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from analysis.identify.identify import identify
from analysis.simulation.synthetic import multisine, synthetic_run
from rig.model.records import Run
from rig.runs.rigs import load_rig
from tests.studies.estimators.coverage import Trial, trial
from tests.studies.pool import Kept, Workers, performed

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
    from hil_sim.scenario.file import Scenario
    from protocols.files.plan import Overrides
    from tests.studies.direct_bench import simulated_run

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


def _name(e: Experiment) -> str:
    words = (e.kind, e.rig, e.protocol, "-".join(e.estimators), f"x{e.noise:g}", f"n{e.repeats}")
    return f"{' '.join(words)} {e.seed}.json"


def all_of(
    experiments: Sequence[Experiment],
    workers: Workers,
    say: Callable[[str], None],
    folder: Path | None = None,
) -> Iterator[tuple[Experiment, dict[str, Trial]]]:
    """Perform experiments on `workers`, in the order they end.

    One that fails (a simulated bench whose piston would leave its limits) is told and left out.
    What is found is kept in `folder`, if given, and what is there already is not done again.
    """
    kept = None
    if folder is not None:
        kept = Kept(
            folder,
            _name,
            lambda found: {name: asdict(one) for name, one in found.items()},
            lambda _, data: {name: Trial(**one) for name, one in data.items()},
        )
        there = sum(e in kept for e in experiments)
        say(f"{there} of {len(experiments)} experiments are in {folder}")

    def report(done: int, of: int, e: Experiment, found: dict[str, Trial] | Exception) -> None:
        if done % 10 == 0 or done == of:
            say(f"{done} of {of} experiments")
        if isinstance(found, Exception):
            say(f"seed {e.seed} failed and is left out: {found}")

    return performed(experiments, perform, workers, report, kept)
