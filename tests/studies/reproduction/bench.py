"""The paper's sections IV and V run on a simulated bench over the wire, and analysed.

Four runs: lock-and-excite with its repeats, validate, both joints at once with the same number of
repeats, and lock-and-excite once more with a mass at the tip, on a second bench whose scenario
file says so. The analysis sees the run folders only; the truth is read for the comparison's sake.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.methods.search import SearchOptions
from analysis.identify.result import Identification
from analysis.regression.rows import default_filtering, paper_filtering
from analysis.simulation.validate import RecordValidation, validate
from protocols.files.plan import Overrides
from rig.cli.execution.protocol_run import ProtocolJob, run_protocol
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.model.records import Run
from rig.model.rig import Rig
from rig.runs.store import load_run
from tests.studies.reproduction.numbers import (
    Choice,
    Experiments,
    Response,
    experiments,
    payload_response,
    search_fit,
    steps_of,
)

RIG = "shinshu-2dof"
IDENTIFY, VALIDATE = "lock-and-excite", "validate"
SIMULTANEOUS_STEP = "both_1hz"
SEARCHES = ("pso", "ga")
SEARCH_STEPS = ("step1_1hz", "step1_3hz")  # STEP1 again, new data
PAYLOAD = 6.5  # [kg], the paper's
Say = Callable[[str], None]


@dataclass(frozen=True)
class Scale:
    """How much of it: repeats of the experiment and of the payload's, candidates per search."""

    repeats: int
    payload_repeats: int
    evaluations: int


FULL = Scale(repeats=10, payload_repeats=4, evaluations=1500)
QUICK = Scale(repeats=3, payload_repeats=2, evaluations=240)


@dataclass(frozen=True)
class Runs:
    """What the benches left: the four runs and the true parameters (of both benches alike)."""

    steps: Run
    judged: Run
    both: Run
    loaded: Run
    truth: Mapping[str, float]


@dataclass(frozen=True)
class Search:
    """A search method's result and its FIT on STEP1's new records."""

    found: Identification
    fits: Sequence[RecordValidation]


@dataclass(frozen=True)
class Simultaneous:
    """The simultaneous method with one filter: all repeats at once, each by itself, its FIT."""

    found: Identification
    each: Experiments
    fits: Sequence[RecordValidation]


@dataclass(frozen=True)
class Reproduction:
    """Everything that the page says. `paper_*` were processed with the paper's own filter."""

    seed: int
    scale: Scale
    rig: Rig
    runs: Runs
    coupled: Identification
    each: Experiments
    paper_each: Experiments
    validation: Sequence[RecordValidation]
    payload: Mapping[str, Response]
    sequential: Identification
    sequential_fits: Sequence[RecordValidation]
    simultaneous: Simultaneous
    paper_simultaneous: Simultaneous
    searches: Mapping[str, Search]


def reproduce(folder: Path, seed: int, scale: Scale, say: Say) -> Reproduction:
    """Run everything into `folder` and analyse it."""
    runs = _record(folder, seed, scale, say)
    return analyse(runs, seed, scale, say)


def _record(folder: Path, seed: int, scale: Scale, say: Say) -> Runs:
    folder.mkdir(parents=True)
    truth, scenario = folder / "truth.json", folder / "payload.yaml"
    scenario.write_text(
        f"description: The paper's payload\neffects:\n  - {{name: payload, mass: {PAYLOAD:g} kg}}\n"
    )
    repeats = Overrides(repeats=scale.repeats)
    together = Overrides(repeats=scale.repeats, duration=10.0, steps=(SIMULTANEOUS_STEP,))
    say(f"starting the simulated bench {RIG}, seed {seed}")
    with simulated_bench(RIG, seed=seed, truth=truth) as endpoint:
        jobs = (
            ProtocolJob(IDENTIFY, RIG, folder / "steps", endpoint, repeats),
            ProtocolJob(VALIDATE, RIG, folder / "validate", endpoint),
            ProtocolJob(VALIDATE, RIG, folder / "both", endpoint, together),
        )
        paths = [run_protocol(job, say) for job in jobs]
    say(f"the same bench with {PAYLOAD:g} kg at the tip")
    with simulated_bench(RIG, seed=seed + 1, scenario=scenario) as endpoint:
        less = Overrides(repeats=scale.payload_repeats)
        paths.append(
            run_protocol(ProtocolJob(IDENTIFY, RIG, folder / "payload", endpoint, less), say)
        )
    steps, judged, both, loaded = (load_run(path) for path in paths)
    return Runs(steps, judged, both, loaded, json.loads(truth.read_text()))


def analyse(runs: Runs, seed: int, scale: Scale, say: Say) -> Reproduction:
    """Identify by every method, validate, and compare."""
    say("identifying by coupling, every experiment by itself and all of them")
    coupled = identify([runs.steps], estimator="ls")  # the paper's
    say("validating on new data")
    validation = validate(coupled.model, [runs.judged])
    say("identifying step by step, then from both joints at once")
    sequential = identify([runs.steps], "sequential")
    return Reproduction(
        seed,
        scale,
        runs.steps.rig,
        runs,
        coupled,
        experiments(runs.steps),
        experiments(runs.steps, paper_filtering),
        validation,
        payload_response(runs.steps.rig, PAYLOAD, coupled, identify([runs.loaded], estimator="ls")),
        sequential,
        validate(sequential.model, [runs.judged]),
        _simultaneous(runs, default_filtering),
        _simultaneous(runs, paper_filtering),
        {method: _search(method, runs, coupled, seed, scale, say) for method in SEARCHES},
    )


def _simultaneous(runs: Runs, filtering: Choice) -> Simultaneous:
    found = identify([runs.both], "simultaneous", None, filtering, reject_noise=False)
    fits = validate(found.model, [steps_of(runs.judged, SEARCH_STEPS)])
    return Simultaneous(found, experiments(runs.both, filtering), fits)


def _search(
    method: str, runs: Runs, coupled: Identification, seed: int, scale: Scale, say: Say
) -> Search:
    say(f"searching STEP1's parameters by {method.upper()}, {scale.evaluations} candidates")
    started = time.monotonic()
    found = identify(
        [runs.steps],
        method,
        rng=np.random.default_rng(seed),
        search=SearchOptions(evaluations=scale.evaluations),
    )
    say(f"{method.upper()} took {time.monotonic() - started:.0f} s")
    return Search(found, search_fit(coupled.model, found, steps_of(runs.judged, SEARCH_STEPS)))
