"""The `loop` verb's work: run, trace, design the next experiment and run it, repeatedly.

Every run has a folder under the loop's: `run-1`, `holdout-1`, then `run-2` from the protocol
`next-2.yaml`, and so on; `bramah trace` can trace each again. A trip, a lost device or Ctrl-C ends
the run and the loop; the results so far are kept.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from analysis.trace.engine import trace
from analysis.trace.loop_rounds import Round, achieved
from analysis.trace.result import CLEAN, EXPLAINED, UNEXPLAINED
from analysis.workers.forked import Forked
from protocols.design.check import check
from protocols.engine.states import ProtocolAborted
from protocols.files import library
from protocols.files.plan import Overrides, resolve
from rig.cli.execution.protocol_run import ProtocolJob, run_protocol
from rig.cli.proof.twin_choice import load_twin, twin_source
from rig.cli.text.output import Countdown
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from rig.runs.files import replace_text
from rig.runs.rigs import load_bench
from rig.runs.store import load_run

log = logging.getLogger(__name__)

PROTOCOL: Final = "lock-and-excite-multisine"
HELD_OUT: Final = Overrides(amplitude_scale=0.7, seed=1007, repeats=2)
SMALLER = 0.8  # factor on the amplitude after each refusal by the bench or its twin
TRIES = 4  # amplitudes of one experiment

FLOOR: Final = "the remaining residual is within the noise"
NOTHING: Final = "no experiment within the limits predicts a separation above the noise"
ROUNDS: Final = "the number of experiments asked for is reached"
DECLINED: Final = "the operator declined the next experiment"
REFUSED: Final = "the bench refused the next experiment"


@dataclass(frozen=True)
class LoopRequest:
    """Settings of a loop: `rounds`, number of designed experiments; `ask`, called before each.

    `until_visible` continues after `clean` while a relevant effect could be below the noise. `keep`
    is called with the loop after each round, to write the result so far.
    """

    rig: str
    out: Path
    endpoint: str | None = None
    protocol: str = PROTOCOL
    overrides: Overrides = field(default_factory=Overrides)
    rounds: int = 4
    seed: int = 0
    until_visible: bool = False
    operator: str | None = None
    ask: Callable[[Mapping[str, Any]], bool] = lambda experiment: True
    keep: Callable[[Loop], None] = lambda loop: None


def refuse_used_folder(out: Path) -> None:
    """Raise InputError if the folder holds the runs of an earlier loop."""
    first_run = out / "run-1"
    if first_run.exists():
        raise InputError(
            f"--out {out}: {first_run} exists already; expected a folder without runs. A loop "
            "begins with its first round: name another folder. `bramah trace` traces the runs that "
            "this one has, and writes the protocol of the next experiment with --json"
        )


class Loop:
    """A running loop: finished `rounds`; `stopped`, the reason of its end ('' while it runs)."""

    def __init__(self, request: LoopRequest, say: Callable[[str], None]) -> None:
        self.request, self.say = request, say
        self.rig: Rig = load_bench(request.rig)
        self.rounds: list[Round] = []
        self.stopped = ""
        self.train: list[Run] = []
        self.judge: list[Run] = []

    def run(self) -> None:
        """Run rounds until an ending condition holds; raises the error that ends a run."""
        self._record(1, self.request.protocol, self.request.overrides, HELD_OUT)
        self._trace(1, None)
        self.request.keep(self)
        while not self.stopped:
            number = len(self.rounds) + 1
            experiment = self._next()
            if experiment is None:
                return
            self.say(f"round {number}: {experiment['text']}")
            if not self.request.ask(experiment):
                self.stopped = DECLINED
            elif not self._perform(number, experiment):
                self.stopped = REFUSED
            else:
                self._trace(number, experiment)
                self.request.keep(self)

    def _next(self) -> Mapping[str, Any] | None:
        """Return the next experiment; None if there is none, with the reason in `stopped`."""
        last = self.rounds[-1].result
        if last.verdict == EXPLAINED or (last.verdict == CLEAN and not self.request.until_visible):
            self.stopped = FLOOR
        elif last.next_experiment is None or "protocol" not in last.next_experiment:
            self.stopped = FLOOR if last.verdict == CLEAN else NOTHING
        elif len(self.rounds) > self.request.rounds:
            self.stopped = ROUNDS
        return None if self.stopped else last.next_experiment

    def _trace(self, number: int, experiment: Mapping[str, Any] | None) -> None:
        self.say(f"round {number}: tracing {sum(len(r.records) for r in self.train)} records")
        result = trace(
            self.train, self.judge, seed=self.request.seed,
            progress=Countdown(f"round {number}: tracing", self.say), pool=Forked(),
        )  # fmt: skip
        gain = None
        if experiment is not None:
            gain = achieved(self.rig, self.train[:-1], self.train[-1], experiment)
        names = tuple(f"{kind}-{number}" for kind in ("run", "holdout"))
        self.rounds.append(Round(number, names, experiment, result, gain))
        self.say(f"round {number}: {result.verdict}: {result.sentence}")

    def _perform(self, number: int, experiment: Mapping[str, Any]) -> bool:
        """Run an experiment and its hold-out variant; False if every amplitude is refused."""
        files = {kind: self.request.out / f"{kind}-{number}.yaml" for kind in ("next", "judge")}
        for path, key in ((files["next"], "protocol"), (files["judge"], "holdout")):
            text = yaml.safe_dump(dict(experiment[key]), sort_keys=False, allow_unicode=True)
            replace_text(path, text)
        # An incomplete model predicts the range of motion badly: leave a margin.
        scale = SMALLER if self.rounds[-1].result.verdict == UNEXPLAINED else 1.0
        for _ in range(TRIES):
            sizes = Overrides(amplitude_scale=scale)
            if all(self._passes_check(path, sizes) for path in files.values()):
                try:
                    self._record(number, str(files["next"]), sizes, sizes, str(files["judge"]))
                    return True
                except ProtocolAborted as error:
                    self.say(f"round {number}: {error}")
                    self._set_aside(number)
            scale *= SMALLER
            self.say(f"round {number}: trying again at {scale:.2f} times the amplitude")
        return False

    def _passes_check(self, path: Path, sizes: Overrides) -> bool:
        try:
            parameters = load_twin(twin_source(self.rig), self.rig)
            plan = resolve(library.load(path), parameters.rig, sizes)
            return check(plan, parameters.rig, parameters.twin, draws=parameters.draws).ok
        except InputError as error:
            log.info("%s at %.2f: %s", path, sizes.amplitude_scale, error)
            return False

    def _record(
        self, number: int, protocol: str, sizes: Overrides, held_out: Overrides,
        held_out_protocol: str | None = None,
    ) -> None:  # fmt: skip
        """Run the training records of a round, then its hold-out records."""
        training = self._run(f"run-{number}", protocol, sizes)
        held_out_run = self._run(f"holdout-{number}", held_out_protocol or protocol, held_out)
        self.train.append(training)
        self.judge.append(held_out_run)

    def _run(self, name: str, protocol: str, sizes: Overrides) -> Run:
        loop = self.request
        self.say(f"{name}: {protocol}")
        out = loop.out / name
        job = ProtocolJob(protocol, loop.rig, out, loop.endpoint, sizes, loop.operator)
        return load_run(run_protocol(job, self.say))

    def _set_aside(self, number: int) -> None:
        """Rename an aborted run, so that the next attempt can use the name."""
        for kind in ("run", "holdout"):
            folder = self.request.out / f"{kind}-{number}"
            if folder.exists():
                k = sum(1 for _ in self.request.out.glob(f"{folder.name}-aborted-*")) + 1
                folder.rename(folder.with_name(f"{folder.name}-aborted-{k}"))
