"""Runs a resolved plan on a bench, step after step, and ends with the outputs at zero.

The engine sends requests; the bench checks and records every sample, and zeroes the outputs on any
exit. Exceptions that end a run early (SafetyTrip, OperatorStop, DeviceLost, ProtocolAborted) are
raised again after the outputs were zeroed and the state was noted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress

from drivers.base import DeviceError, DeviceLost
from protocols.engine.plan_runner import OnPhase, PlanRunner
from protocols.engine.run_inputs import RunInputs
from protocols.engine.states import EngineState, ProtocolAborted, RunEnded
from protocols.files.plan import Plan
from protocols.files.schema import Retry
from protocols.steps.base import PlannedStep
from rig.bench.session import Bench
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed, SafetyTrip

log = logging.getLogger(__name__)


def run(
    plan: Plan,
    rig: Rig,
    bench: Bench,
    on_phase: OnPhase | None = None,
    inputs: RunInputs | None = None,
) -> None:
    """Run every step of a plan; the records are in the bench's recorder when it returns.

    `on_phase` is called with every phase: "place", "lock", "warm-up", "centre", "record", "stop",
    "done" and those of the other steps; `inputs` connects people and estimates. Raises
    ProtocolAborted (or its LockFailed) if the bench fails a requirement of a step, and the bench's
    own exceptions; in every case the outputs were put to zero first.
    """
    runner = PlanRunner(plan, rig, bench, on_phase or _nobody, inputs or RunInputs())
    machine = runner.machine
    machine.listen(runner.note_state)
    bench.listen(runner.inputs.control.accept)
    machine.to(EngineState.IDLE, "the plan is proved")
    try:
        _run_steps(plan, runner)
        runner.report_phase(plan.sequence[-1].name, "done", 0, 0, f"{runner.records} records")
    except SafetyTrip as trip:
        _trip(plan, runner, trip)
        raise
    finally:
        _make_safe(runner)


def _nobody(step: str, phase: str, repeat: int, repeats: int, message: str) -> None:
    log.debug("%s %s %d/%d %s", step, phase, repeat, repeats, message)


def _run_steps(plan: Plan, runner: PlanRunner) -> None:
    """Run the steps; failed ones are skipped or retried as the protocol allows."""
    skipped, attempts = 0, 0
    rule, retry = plan.protocol.on_error, plan.protocol.retry
    pending: Sequence[PlannedStep] = plan.sequence
    while pending:
        step = pending[0]
        runner.begin(step, pending[1:])
        try:
            runner.do(step)
        except DeviceLost as error:
            attempts = _reconnect(runner, error, retry, attempts)
            continue
        except RunEnded:
            raise
        except ProtocolAborted as error:
            runner.rest_now(f"{step.name} failed")
            if rule.then != "skip" or skipped >= rule.at_most:
                raise
            skipped += 1
            runner.mark(rule.mark or f"{step.name} is skipped: {error}")
            log.warning("%s is skipped: %s", step.name, error)
        pending = pending[1:]


def _reconnect(runner: PlanRunner, error: DeviceLost, retry: Retry | None, attempts: int) -> int:
    """Zero the outputs and reconnect; return `attempts` in the whole run, with those made here.

    Raises DeviceLost where no attempt is left.
    """
    while retry is not None and attempts < retry.times:
        attempts += 1
        remaining = retry.times - attempts
        log.warning("%s; connecting again in %g s, %d more allowed", error, retry.wait, remaining)
        runner.rest_now("the device was lost", confirmed=False)
        runner.bench.event("device lost", runner.bench.tick, message=str(error), retries=remaining)
        try:
            runner.reconnect(retry.wait)
        except DeviceLost as again:  # a device that restarts may need longer than one wait
            error = again
            continue
        runner.bench.event("device back", runner.bench.tick)
        return attempts
    raise error


def _trip(plan: Plan, runner: PlanRunner, trip: SafetyTrip) -> None:
    runner.machine.to(EngineState.TRIPPED, str(trip))
    if plan.protocol.on_trip.mark:
        with suppress(RecordingFailed):
            runner.mark(plan.protocol.on_trip.mark)


def _make_safe(runner: PlanRunner) -> None:
    """Zero the outputs and note it; without the device's confirmation the state is unchanged."""
    try:
        confirmed = runner.bench.zero_outputs()
    except DeviceError as error:
        log.error("%s", error)
        confirmed = False
    if confirmed:
        with suppress(RecordingFailed):
            runner.machine.to(EngineState.SAFE, "outputs confirmed at zero")
