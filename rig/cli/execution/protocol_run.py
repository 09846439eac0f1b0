"""Run a protocol: check it on the twin, drive the bench, record. Clear a trip."""

from __future__ import annotations

import hashlib
import math
import select
import shlex
import shutil
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
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
from rig.cli.execution.device import (
    bench_at,
    device_of,
    only_bench,
    refuse_endpoint_alone,
    warn_of_limits,
)
from rig.cli.proof.proofs import proved
from rig.cli.proof.twin_choice import twin_source
from rig.cli.text.output import Countdown, Say, clock_text, is_terminal
from rig.cli.text.sheets import plan_text
from rig.model.parse import InputError, shipped_files
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig, rig_text
from rig.runs.store import refuse_occupied

if TYPE_CHECKING:
    from rig.cli.execution.tracking import Tracking


# A sample takes 8 bytes per channel in the journal, the same in records.h5, which is written before
# the journal is removed, and some more in the journal's write-ahead log.
COPIES = 2.5
SPARE = 200e6  # [bytes] that must stay free on the disk


@dataclass(frozen=True)
class ProtocolJob:
    """One unattended run: protocol, bench and run folder.

    It is proved on the twin with the parameters of `model`, by default of the last identified one,
    or with `nominal` the rig file's. `memory` [s] is the tracker's forgetting time constant.
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


class _PhaseReport:
    """Reports the phases of a run to the terminal, the run's log and attached screens."""

    def __init__(self, bench: Bench, say: Say) -> None:
        self._bench, self._say = bench, say
        self._message = ""

    def phase(self, step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
        recorder = self._bench.recorder
        at = 0.0 if recorder is None else recorder.elapsed
        left = self._bench.expected - at
        # The expected duration counts whole phases, one of which may have ended early.
        suffix = f"  ({clock_text(left)} left)" if left > 0.0 and phase != "done" else ""
        self._say(f"{at:8.1f} s  {step:10s} {phase:8s}  {message}{suffix}")
        self._message = message
        self._bench.event("phase", self._bench.tick, step=step, phase=phase, message=message)
        self._bench.status(step=step, phase=phase, repeat=repeat, repeats=repeats, message=message)

    def tracked(self, tracking: Tracking, estimate: str) -> None:
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
        # A run must not fail because no screen can attach.
        say(f"no screen can attach to this run: {error}")
        return None


def _tracking(
    job: ProtocolJob, plan: Plan, rig: Rig, say: Say, stack: ExitStack
) -> Tracking | None:
    if not job.track and not plan.estimates:
        return None
    from rig.cli.execution.tracking import Tracking

    return stack.enter_context(Tracking(rig, job.out, say, job.memory))


def terminal_lines(attended: bool | None) -> Callable[[], str | None] | None:
    """Return a function that reads a typed line without waiting; None for an unattended run.

    By default a run is attended if its standard input and standard error are terminals.
    """
    if attended is None:
        attended = is_terminal(sys.stdin) and is_terminal(sys.stderr)
    return _read_answer if attended else None


def _read_answer() -> str | None:
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    if not ready:
        return None
    line = sys.stdin.readline()
    return line.rstrip("\n") if line else None


def needed_bytes(plan: Plan, rig: Rig) -> float:
    """Return the size [bytes] of a run in which every condition reaches its time-out."""
    return COPIES * 8.0 * len(rig.recorded) * rig.sample_rate * plan.longest


def require_space(plan: Plan, rig: Rig, out: Path) -> None:
    """Raise InputError if the disk of `out` has too little free space for the run."""
    folder = out.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    needed = needed_bytes(plan, rig)
    if needed + SPARE > free:
        raise InputError(
            f"{out}: the run needs up to {needed / 1e6:.0f} MB ({plan.longest:.0f} s at "
            f"{rig.sample_rate:g} Hz) and {SPARE / 1e6:.0f} MB to spare, "
            f"the disk has {free / 1e6:.0f} MB; free space, or choose a folder on another disk"
        )


def _file(text: str, source: str) -> dict[str, str]:
    return {"source": source, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def _protocol_text(name: str) -> tuple[str, str]:
    shipped = shipped_files("protocols", "shipped")
    if name in shipped:
        return shipped[name].read_text("utf-8"), f"{name}.yaml (shipped)"
    path = Path(name).absolute()
    return path.read_text("utf-8"), str(path)


def _seeds(plan: Plan) -> dict[str, int]:
    """Return the seeds of the played signals by step and joint."""
    return {
        f"{step.name} joint {excited.joint}": int(seed)
        for step in plan.protocol.excitations
        for excited in step.excite
        if (seed := getattr(excited.signal, "seed", None)) is not None
    }


def _provenance(job: ProtocolJob, plan: Plan) -> dict[str, Any]:
    """Return the provenance of a run for its run.yaml: what is needed to repeat it."""
    text, source = rig_text(job.rig)
    defaults = asdict(Overrides())
    changed = {k: v for k, v in asdict(job.overrides).items() if v != defaults[k]}
    return {
        "command": shlex.join(["bramah", *sys.argv[1:]]),
        "files": {"protocol": _file(*_protocol_text(job.protocol)), "rig": _file(text, source)},
        "overrides": {k: list(v) if isinstance(v, tuple) else v for k, v in changed.items()},
        "seeds": _seeds(plan),
    }


def run_protocol(job: ProtocolJob, say: Say) -> Path:
    """Run a protocol and return its run folder; raises the error that ended it, outputs at zero."""
    rig, overrides = bench_at(job.rig, job.endpoint), job.overrides
    warn_of_limits(rig, say)
    plan = resolve(library.load(job.protocol, overrides.parameters), rig, overrides)
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
    plural = "" if len(plan.records) == 1 else "s"
    say(
        f"running {len(plan.records)} record{plural}, about {plan.seconds:.0f} s of the device's "
        "time"
    )
    recorder = Recorder(
        job.out,
        rig,
        protocol=plan.protocol.model_dump(mode="json"),
        operator=job.operator,
        provenance=_provenance(job, plan),
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
            tracking.subscribe(report.note, partial(report.tracked, tracking))
            bench.observers.add(tracking)
            inputs = replace(inputs, estimates=tracking)
        engine.run(plan, rig, bench, report.phase, inputs)
    return job.out


def reset_device(rig: str | None, endpoint: str | None, reason: str) -> str:
    """Clear a bench's latched trip for a person's `reason`; return the cause of the trip.

    `rig` may also be the name in a rig file, as in messages on a trip: this is the rig driven under
    that name at `endpoint`, else the one driven last. The default is the only bench with a stored
    trip.
    """
    refuse_endpoint_alone(rig, endpoint)
    if rig is None:
        rig = str(only_bench(tripped_rigs(), "no trip is stored on this computer", "tripped"))
    named = [(path, found.wire.endpoint) for path in known_rigs() if (found := _named(path, rig))]
    tripped = [path for path, at in named if at == endpoint]
    try:
        bench, driver = device_of(str(tripped[0]) if tripped else rig, endpoint)
    except InputError:
        if not named:
            raise
        latest = max((path for path, _ in named), key=lambda path: path.stat().st_mtime)
        bench, driver = device_of(str(latest), endpoint)
    return reset_bench(bench, driver, reason)


def _named(path: Path, name: str) -> Rig | None:
    """Return the rig of a file if it can be read and has this name."""
    try:
        rig = load_rig(path)
    except InputError:
        return None
    return rig if rig.name == name else None
