"""The bench: one session with a device; every exit sets the outputs to zero first.

Order on any exit: outputs to zero, wire closed, data flushed, then the report. Signals set a flag
that the exchange loop reads, so that nothing interrupts the zeroing. A trip latches: no session
with this bench begins until a person has cleared the trip (`rig.bench.latch`).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.base import (
    AsksAhead,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    Driver,
    LatchesTrip,
    OutputLaw,
    SampleBlock,
)
from rig.bench.alarms import AlarmLog, event_fields
from rig.bench.guard import Guard, GuardSettings, JointRole
from rig.bench.latch import BenchState
from rig.bench.lateness import ArrivalClock, HostTiming
from rig.bench.observers import Observers, RecordHandle
from rig.bench.outputs import UNSURE, Outputs
from rig.bench.screens.commands import ACKNOWLEDGE, RELEASE, STOP, TAKE, Judge
from rig.bench.screens.display import LOST, Display
from rig.bench.screens.snapshot import PlanLine
from rig.bench.screens.sockets import Publisher
from rig.bench.settings import BENCH
from rig.bench.stops import StopFlag
from rig.model.alarms.states import AlarmTable
from rig.model.rig import Rig
from rig.model.trips import (
    Latched,
    OperatorStop,
    RecordingFailed,
    SafetyTrip,
    Violation,
    reset_command,
)
from rig.runs import runstate
from rig.runs.recorder import Recorder, RecordMeta

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
_CONTROLS = {TAKE: "taken", RELEASE: "released"}


class Bench:
    """A session with the device of `driver`; a context manager that closes driver and publisher.

    Call `exchange` (or `run_for`) at intervals shorter than the rig's watchdog; do not wait
    elsewhere. Raises InputError, Latched, DeviceBusy, DeviceError, DeviceLost, RecordingFailed on
    entry; later these, SafetyTrip and OperatorStop, each with the outputs already at zero. `state`
    is the stored state of the bench, by default of the one at the rig's wire.
    """

    info: DeviceInfo

    def __init__(
        self,
        rig: Rig,
        driver: Driver,
        recorder: Recorder | None = None,
        publisher: Publisher | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        settings: GuardSettings | None = None,
        signals: bool = True,
        state: BenchState | None = None,
    ) -> None:
        self.rig = rig
        self.state = state or BenchState(rig.wire)
        self.recorder = recorder
        self.observers = Observers()
        self.trip: SafetyTrip | None = None
        self.lost_samples = 0
        self.tick = 0
        self._columns = len(rig.recorded)
        self._outputs = Outputs(rig, driver)
        self._driver = driver
        self._ask_ahead = driver.ask_ahead if isinstance(driver, AsksAhead) else _nothing
        self._clock = clock
        self._guard = Guard(rig, settings)
        self._alarms = AlarmLog(rig, lambda event, tick, about: self.event(event, tick, **about))
        self._stop = StopFlag()
        self._signals = signals
        self._display = Display(rig, publisher, _folder_of(recorder), clock)
        self._arrival: ArrivalClock | None = None
        self._timing = HostTiming(rig.sample_rate)
        self._expected: int | None = None
        self._judge: Judge | None = None
        # Recorded with the outputs at zero after an early end [s].
        self.recorded_after = BENCH.zero_seconds

    # Entry and exit

    def __enter__(self) -> Self:
        if self._signals:
            self._stop.install()
        try:
            self.state.refuse_if_tripped(self.rig)
            self.state.prepare()
            self.state.occupy()
            self.state.describe(self.rig)
            self.info = self._connect()
            self.state.take(None if self.recorder is None else self.recorder.folder)
            cause = self._outputs.safely(self._driver.trip_cause)
            if cause is not None:
                raise Latched(f"the device tripped earlier and is not reset: {cause}", self.rig)
            if self.recorder is not None:
                self.recorder.open(self.info)
            self.restart()
        except BaseException as error:
            self._leave(error)
            raise
        return self

    def _connect(self) -> DeviceInfo:
        try:
            return self._outputs.connect()
        except DeviceBusy as error:
            raise self.state.in_use(error) from error

    def restart(self) -> None:
        """Start or restart the device's stream of blocks and its waveforms."""
        self._outputs.safely(self._driver.start)
        self._expected = None
        self._guard.forget()
        self._arrival = None if self.info.virtual_time else ArrivalClock(self.info.sample_rate)
        if self.recorder is not None:
            self.recorder.begin_stream()

    def reconnect(self, wait: float) -> None:
        """Connect again to a lost device after `wait` [s], and zero the outputs first.

        Raises OperatorStop during the wait, DeviceError or a subclass if the device is still lost.
        """
        self._outputs.close()
        deadline = self._clock() + wait
        self.status(device=LOST)
        while self._clock() < deadline:
            self._obey_requests()
            self._display.repeat()
            time.sleep(min(0.1, max(0.0, deadline - self._clock())))
        self.info = self._connect()
        cause = self._outputs.safely(self._driver.trip_cause)
        if cause is not None:
            raise Latched(f"the device tripped meanwhile and is not reset: {cause}", self.rig)
        self.status(device="")
        self.restart()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        confirmed = self._leave(error)
        if error is None and self._stop.reason is not None:
            raise OperatorStop(f"{self._stop.reason}; the run itself was complete")
        if error is None and not confirmed:
            raise DeviceLost(f"{UNSURE}; the run itself was complete")

    def _leave(self, error: BaseException | None) -> bool:
        """Zero the outputs, close the wire, flush, report; return whether zero was confirmed.

        The signal handlers are restored last.
        """
        state, message = _outcome(error)
        unsure = f"{message}; {UNSURE}".lstrip("; ")
        confirmed = False
        try:
            confirmed = self._outputs.surely_zero()
            # Published first because a screen waits for it, and writing the data can take seconds.
            lost = isinstance(error, DeviceLost)
            self._display.ended(state, message if confirmed else unsure, lost=lost)
            if confirmed and not self._ends_at_zero(error):
                log.error("%s: the device still reports a command", UNSURE, extra={"alarm": True})
                confirmed = False
            if not self._outputs.close(tripped=self.trip is not None) or not confirmed:
                confirmed, message = False, unsure
                self._display.ended(state, message)
                if error is not None:
                    error.add_note(UNSURE)
        finally:
            self.state.release(at_zero=confirmed)
            try:
                self._flush(state, message, error)
            finally:
                self._display.close()
                self._stop.restore()
        return confirmed

    def _ends_at_zero(self, error: BaseException | None) -> bool:
        """Record the outputs at zero after an early end; False if the device reports a command."""
        early = error is not None or self._stop.reason is not None
        recording = self.recorder is not None and self.recorder.is_open
        if not early or not recording or self._expected is None:
            return True

        def keep(block: SampleBlock) -> None:
            lost = self._continue(block)
            with self._outputs:
                self._keep(block, None, lost)
            # The last picture on a screen has the outputs at zero.
            self._display.show(block, 0.0, self.lost_samples, self._guard.roles)

        at_zero = self._outputs.record_zero(keep, self._clock, self.recorded_after)
        self._display.last()
        return at_zero

    def _flush(self, state: str, message: str, error: BaseException | None) -> None:
        if self.recorder is None:
            return
        timing = self._timing.summary()
        if timing is not None:
            with suppress(RecordingFailed):
                self.event("host timing", None, **timing)
        try:
            self.recorder.finish(state, message)
        except RecordingFailed as problem:
            if error is None:
                raise
            log.error("%s", problem)  # the user is told the first error
            return
        if self.trip is not None:
            from rig.runs.exchange.trip_window import write_trip_window  # noqa: PLC0415 - as h5py

            around = write_trip_window(self.recorder.folder)
            if around is not None:
                self.trip.add_note(f"the 2 s before and after the trip are in {around}")

    # Outputs

    def zero_outputs(self) -> bool:
        """Set the outputs to zero now; False (and logged) if the device does not confirm it."""
        return self._outputs.zero()

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of the waveform [V] of joint `joint` (0-based), shape (period,)."""
        values = np.asarray(wave, dtype=np.float64)
        if values.ndim != 1 or len(values) == 0 or not np.isfinite(values).all():
            raise ValueError("expected a waveform of shape (n,), n > 0, of finite numbers")
        self._obey_requests()
        self._outputs.safely(lambda: self._driver.upload(joint, values))

    def apply(self, laws: Sequence[OutputLaw], restart: bool = False) -> int:
        """Set the laws of all joints at one tick, bounded by each joint's limits.command.

        `restart` starts the waveforms at that tick. Returns the tick; raises ValueError for a wrong
        number of laws, or for values that are not finite, SafetyTrip where the device has tripped.
        """
        bounded = self._outputs.bounded(laws)
        self._obey_requests()
        try:
            return self._outputs.apply(bounded, restart=restart)
        except DeviceLost:
            raise
        except DeviceError as error:
            self._trip_as_device(error)
            raise

    def _trip_as_device(self, error: DeviceError) -> None:
        """Raise SafetyTrip if the device refused a law because it has tripped meanwhile."""
        cause = None
        with suppress(DeviceError):
            cause = self._driver.trip_cause()
        if cause is None:
            return
        violation = self._timed(self._guard.device_tripped(self.tick))
        trip = self._latch(violation)
        trip.add_note(f"device: {cause}")
        self._note_alarms(violation)
        self._report(trip)
        raise trip from error

    # Samples

    def exchange(self, more: bool = False) -> SampleBlock:
        """Read one block, check every sample, journal it, publish it.

        `more`: another exchange follows without a command in between (unless an error occurs); in
        virtual time the device then prepares the next block while this one is checked. Raises
        SafetyTrip, OperatorStop, DeviceLost, DeviceError or RecordingFailed, each with the outputs
        zeroed first; a block that trips is journalled as well.
        """
        self._refuse_ended()  # commands of screens were read after the block before
        trip = None
        with self._outputs:
            block = self._driver.read_block()
            if more:
                self._ask_ahead()
            late = None if self._arrival is None else self._arrival.late(block, self._clock())
            lost = self._continue(block)
            violation = self._inspect(block, lost, late)
            if violation is not None:
                self.zero_outputs()
                violation = self._timed(violation)
                trip = self._latch(violation)
            self._keep(block, late, lost)
            self._timing.add(block)
            self._note_alarms(violation)
        self.observers.block(block)
        self._display.show(block, late or 0.0, self.lost_samples, self._guard.roles)
        if self._outputs.zeroed_elsewhere(block):
            # The run's next law would move joints that another program has stopped.
            self._stop.request("stopped: another program has put the outputs to zero")
        if trip is not None:
            self._report(trip)
            raise trip
        self._obey_requests()
        return block

    def _note_alarms(self, trip: Violation | None) -> None:
        """Write warnings and the trip to the events of the run, and publish them."""
        try:
            warnings = {key: self._timed(v) for key, v in self._guard.warnings.items()}
            self._alarms.update(warnings, self.tick)
            if trip is not None:
                self._alarms.trip(trip)
        except RecordingFailed:
            if trip is None:  # otherwise the trip is the error to report
                raise
        self._display.alarms = self._alarms.table

    def _continue(self, block: SampleBlock) -> int:
        """Return the count of samples missing before a block; raises DeviceError if invalid."""
        columns = self._columns
        if block.data.ndim != 2 or block.data.shape[1] != columns or len(block.data) == 0:
            raise DeviceError(f"found a block of shape {block.data.shape}, expected (n, {columns})")
        lost = 0 if self._expected is None else block.tick - self._expected
        if lost < 0:
            raise DeviceError(
                f"samples out of order: found a block of tick {block.tick}, expected "
                f"{self._expected} or later"
            )
        self._expected = self.tick = block.tick + len(block.data)
        self.lost_samples += lost
        return lost

    def _inspect(self, block: SampleBlock, lost: int, late: float | None) -> Violation | None:
        blind = self._guard.gap(lost, block.tick) if lost else None
        violation = blind or self._guard.check(block)
        if violation is None and late is not None:
            violation = self._guard.stale(late, block.tick)
        if violation is None and block.tripped:
            violation = self._guard.device_tripped(block.tick)
        return violation

    def _timed(self, violation: Violation) -> Violation:
        """Return a violation with its time since the run began, where a run is recorded."""
        if self.recorder is None:
            return violation
        return replace(violation, seconds=self.recorder.time_of(violation.tick))

    def _keep(self, block: SampleBlock, late: float | None, lost: int) -> None:
        if self.recorder is None:
            return
        if lost:
            self.recorder.event("samples lost", block.tick - lost, lost=lost)
        self.recorder.append(block, late)

    def _latch(self, violation: Violation) -> SafetyTrip:
        self.trip = SafetyTrip(violation, self.rig)
        self.trip.add_note(self._alarms.alarm_of(violation, trips=True).remedy.rstrip("."))
        self._display.trip = str(self.trip)
        folder = None if self.recorder is None else self.recorder.folder
        if self.state.latch(str(self.trip), self.rig, folder):
            self.trip.add_note(
                f"inspect the bench, then clear the trip with `{reset_command(self.rig)}`"
            )
        if not isinstance(self._driver, LatchesTrip):
            self.trip.add_note(
                f"latched on this computer only: over wire {self.rig.wire.kind} the device keeps "
                "no trip, so other computers and users are not refused"
            )
        return self.trip

    def _report(self, trip: SafetyTrip) -> None:
        log.info("%s", trip)
        about = event_fields(trip.violation)
        with suppress(RecordingFailed):  # the trip is the error to report
            self.event("trip", trip.tick, message=str(trip), **about)

    def _obey_requests(self) -> None:
        """Do what screens command; raise a requested stop or a latched trip."""
        for command in self._display.commands(self._judge):
            if command.word == STOP:
                self._stop.request("stopped by operator (from the screen)")
            elif command.word == ACKNOWLEDGE:
                self.acknowledge(command.value or None)
            elif command.word in (TAKE, RELEASE):
                with suppress(RecordingFailed):  # the next block says so, with the outputs at zero
                    self.event(f"controls {_CONTROLS[command.word]}", self.tick, by=command.holder)
        self._refuse_ended()

    def _refuse_ended(self) -> None:
        """Raise a requested stop or a latched trip."""
        if self._stop.reason is not None:
            self.zero_outputs()
            with suppress(RecordingFailed):
                self.event("stop", self.tick, reason=self._stop.reason)
            raise OperatorStop(self._stop.reason)
        if self.trip is not None:
            self.zero_outputs()
            raise self.trip

    @property
    def alarms(self) -> AlarmTable:
        """The active alarms."""
        return self._alarms.table

    def acknowledge(self, alarm: str | None = None) -> None:
        """Acknowledge an alarm by its key, or all of them, for a person."""
        with suppress(RecordingFailed):  # the next block says so, with the outputs at zero
            self._alarms.acknowledge(alarm, self.tick)
        self._display.alarms = self._alarms.table

    def run_for(self, seconds: float, watch: Callable[[SampleBlock], None] | None = None) -> Array:
        """Exchange until `seconds` of device time have passed; return the samples.

        Shape (n, channels) in the order of `Rig.recorded`, to the end of the last block, without
        the samples lost on the wire. `watch` is called with every block; if it raises, the outputs
        are zeroed.
        """
        rate = self.rig.sample_rate
        samples, blocks = 0, []
        needed = math.ceil(seconds * rate - 1e-6)
        while samples < needed:
            expected = self._expected
            block = self.exchange(more=needed - samples > self.info.block_samples)
            samples += len(block.data) if expected is None else self.tick - expected
            blocks.append(block.data)
            if watch is not None:
                self._outputs.safely(lambda b=block: watch(b))  # type: ignore[misc]
        return np.concatenate(blocks) if blocks else np.empty((0, len(self.rig.recorded)))

    # Called by the engine

    def guard(self, roles: Sequence[JointRole]) -> None:
        """Set the roles from the next block on, one per joint."""
        self._guard.set_roles(roles)

    def listen(self, judge: Judge) -> None:
        """Let `judge` accept or refuse the commands of screens, except stop."""
        self._judge = judge

    def describe(self, plan: Sequence[PlanLine]) -> None:
        """Set the steps of the plan."""
        self._display.describe(plan)

    def status(self, **changes: Any) -> None:
        """Set the protocol's progress: fields of `rig.bench.screens.snapshot.Progress`."""
        self._display.progress = replace(self._display.progress, **changes)

    @property
    def expected(self) -> float:
        """The expected duration of the run [s], as last set by `status`; 0: unknown."""
        return self._display.progress.total_s

    def event(self, event: str, tick: int | None = None, **fields: Any) -> None:
        """Write one event to the run's log."""
        if self.recorder is not None and self.recorder.is_open:
            self.recorder.event(event, tick, **fields)

    def record(
        self,
        meta: RecordMeta | None = None,
        *,
        start_tick: int | None = None,
        ticks: int | None = None,
        **fields: Any,
    ) -> RecordHandle:
        """Mark a tick range as a record: ``with bench.record(step="step1", repeat=2) as record:``.

        Give a RecordMeta or its fields. By default the record spans the samples exchanged within
        the `with` block; `start_tick` and `ticks` fix it in advance (as returned by `apply`) or
        afterwards.
        """
        description = RecordMeta(**fields) if meta is None else meta
        if start_tick is None:
            if self._expected is None:
                raise ValueError("no tick is known yet: exchange a block first, or give start_tick")
            start_tick = self._expected
        return RecordHandle(self, description, start_tick, ticks)


def _nothing() -> None:
    pass


def _folder_of(recorder: Recorder | None) -> str:
    """Return the absolute path of the run's folder, since a screen may run in another folder."""
    return "" if recorder is None else str(recorder.folder.absolute())


def _outcome(error: BaseException | None) -> tuple[str, str]:
    """Return the final state of a run and its reason in one line."""
    if error is None:
        return runstate.DONE, ""
    if isinstance(error, SafetyTrip):
        return runstate.TRIPPED, str(error)
    if isinstance(error, KeyboardInterrupt):
        return runstate.ABORTED, "stopped by operator (Ctrl-C)"
    if isinstance(error, DeviceError):  # a reader of the folder sees that the device was the cause
        return runstate.ABORTED, f"device: {error}"
    return runstate.ABORTED, str(error) or type(error).__name__
