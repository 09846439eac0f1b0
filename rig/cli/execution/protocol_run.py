"""The work of the verbs `run` and `reset`: protocol, check on the twin, bench, run folder."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import make_driver
from protocols.engine import engine
from protocols.engine.run_inputs import RunInputs
from protocols.engine.states import EngineState, StateMachine
from protocols.files import library
from protocols.files.plan import Overrides, Plan, resolve
from rig.bench.latch import known_rigs, reset_bench, tripped_rigs
from rig.bench.screens.snapshot import PlanLine
from rig.bench.screens.sockets import AttachError, Publisher
from rig.bench.session import Bench
from rig.cli.execution.attended import TrackedEstimates, terminal_lines
from rig.cli.execution.device import (
    bench_at,
    device_of,
    refuse_endpoint_alone,
    the_only,
)
from rig.cli.proof.proofs import proved
from rig.cli.proof.space import require_space
from rig.cli.proof.twin_choice import twin_source
from rig.cli.provenance import provenance_of
from rig.cli.text.output import Countdown, clock_text
from rig.cli.text.sheets import plan_text
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.store import refuse_occupied

if TYPE_CHECKING:
    from rig.cli.identification.tracking import Tracking

Say = Callable[[str], None]


@dataclass(frozen=True)
class ProtocolJob:
    """One unattended run: protocol, bench and run folder.

    It is proved on the twin with the parameters of `model`, of the last identified one, or nominal.
    """

    protocol: str
    rig: str
    out: Path
    endpoint: str | None = None
    overrides: Overrides = field(default_factory=Overrides)
    operator: str | None = None
    track: bool = False
    memory: float = math.inf
    attended: bool | None = False
    model: Path | None = None
    nominal: bool = False


def _plan(job: ProtocolJob) -> tuple[Rig, Plan]:
    bench, how = bench_at(job.rig, job.endpoint), job.overrides
    return bench, resolve(library.load(job.protocol, how.parameters), bench, how)


class _PhaseReport:
    """Reports the phases of a run to the terminal, the run's log and attached screens."""

    def __init__(self, bench: Bench, say: Say) -> None:
        self._bench, self._say = bench, say
        self._message = ""

    def phase(self, step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
        recorder = self._bench.recorder
        at = 0.0 if recorder is None else recorder.elapsed
        left = self._bench.expected - at
        # The estimate counts the whole phase, which may have ended early.
        more = f"  ({clock_text(left)} left)" if left > 0.0 and phase != "done" else ""
        self._say(f"{at:8.1f} s  {step:10s} {phase:8s}  {message}{more}")
        self._message = message
        self._bench.event("phase", self._bench.tick, step=step, phase=phase, message=message)
        self._bench.status(
            step=step,
            phase=phase,
            repeat=repeat,
            repeats=repeats,
            message=message,
        )

    def tracked(self, estimate: str, tracking: Tracking) -> None:
        """Publish an estimate, all estimates with their intervals, and the residuals."""
        tracked_values = tracking.parameters.items()
        known = {name: [interval["value"], *interval["ci95"]] for name, interval in tracked_values}
        message = f"{self._message}; {estimate}"
        self._bench.status(message=message, estimates=known, residuals=tracking.residuals)

    def note(self, entry: dict[str, Any]) -> None:
        """Write the estimates at a record's end to the run's log."""
        self._bench.event("tracked", self._bench.tick, **entry)


def _publisher(rig: Rig, say: Say) -> Publisher | None:
    try:
        return Publisher(rig.name)
    except AttachError as error:
        # A run must not fail for want of a screen.
        say(f"no screen can attach to this run: {error}")
        return None


def _tracking(
    job: ProtocolJob, plan: Plan, rig: Rig, say: Say, stack: ExitStack
) -> Tracking | None:
    if not job.track and not plan.estimates:
        return None
    from rig.cli.identification.tracking import Tracking

    return stack.enter_context(Tracking(rig, job.out, say, job.memory))


def run_protocol(job: ProtocolJob, say: Say) -> Path:
    """Run a protocol and return its run folder; raises the error that ended it, outputs at zero."""
    rig, plan = _plan(job)
    refuse_occupied(job.out)
    run_machine = StateMachine()
    run_machine.to(EngineState.CHECKING, plan.protocol.name)
    say(plan_text(plan))
    require_space(plan, rig, job.out)
    say(f"checking {plan.protocol.name} on the twin of {rig.name}")
    source = twin_source(rig, job.model, job.nominal)
    proof = proved(plan, rig, progress=Countdown("checking", say), source=source)
    say(proof.twin_text)
    proof.report.require()
    for note in proof.report.notes:
        say(f"note: {note}")
    many = "" if len(plan.records) == 1 else "s"
    say(
        f"running {len(plan.records)} record{many}, about {plan.seconds:.0f} s of the device's time"
    )
    recorder = Recorder(
        job.out,
        rig,
        protocol=plan.protocol.model_dump(mode="json"),
        operator=job.operator,
        provenance=provenance_of(job.protocol, job.rig, job.overrides, plan),
    )
    with ExitStack() as stack:
        tracking = _tracking(job, plan, rig, say, stack)
        publisher = _publisher(rig, say)
        bench = stack.enter_context(Bench(rig, make_driver(rig.wire, rig), recorder, publisher))
        bench.recorded_after = plan.protocol.on_trip.record
        proof.keep(job.out)
        report = _PhaseReport(bench, say)
        bench.describe([PlanLine(part.name, part.title, part.seconds) for part in plan.sequence])
        inputs = RunInputs(machine=run_machine, terminal=terminal_lines(job.attended))
        if tracking is not None:
            followed = tracking  # for mypy: not None in the closure
            tracking.subscribe(report.note, lambda text: report.tracked(text, followed))
            bench.observers.add(tracking)
            inputs = replace(inputs, estimates=TrackedEstimates(tracking))
        engine.run(plan, rig, bench, report.phase, inputs)
    return job.out


def reset_device(rig: str | None, endpoint: str | None, reason: str) -> str:
    """Clear a bench's latched trip for a person's `reason`; return the cause of the trip.

    `rig` may be the name in a rig file too, as messages on a trip state it: the rig is then that
    which was driven last under this name. Without one it is the only bench with a stored trip.
    """
    refuse_endpoint_alone(rig, endpoint)
    if rig is None:
        rig = str(the_only(tripped_rigs(), "no trip is stored on this computer", "tripped"))
    try:
        described, driver = device_of(rig, endpoint)
    except InputError:
        known = [path for path in known_rigs() if _is_named(path, rig)]
        if not known:
            raise
        latest = max(known, key=lambda path: path.stat().st_mtime)
        described, driver = device_of(str(latest), endpoint)
    return reset_bench(described, driver, reason)


def _is_named(path: Path, name: str) -> bool:
    """Return whether a rig that can be read has a name."""
    try:
        return load_rig(path).name == name
    except InputError:
        return False
