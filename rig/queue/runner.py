"""The runner of a queue: one process that starts the items one at a time.

Every item runs as a child process. The state `running` is on disk before the child starts, and the
child holds the item's lock while it runs. After a killed runner, the next one therefore determines
whether the child still runs (and waits for it), has ended (its run folder says how) or was killed
(its run is recovered). An item is started a second time only by a person.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self

from rig.bench import latch
from rig.bench.outputs import UNSURE
from rig.bench.stops import StopFlag
from rig.model.parse import InputError
from rig.model.trips import OperatorStop
from rig.queue import items as it
from rig.queue import processes, ready
from rig.queue.hook import Hook
from rig.queue.items import Item, QueueJob
from rig.queue.outcome import ItemOutcome, outcome_of, outcome_of_folder
from rig.queue.processes import LockFile, held, holder
from rig.queue.store import QueueStore
from rig.runs import runstate, store
from rig.runs.rigs import load_rig

log = logging.getLogger(__name__)
Say = Callable[[str], None]

ENDED: Final = "nothing more to start"
PAUSED: Final = "paused"


@dataclass(frozen=True)
class QueueSettings:
    """Times [s] and counts of a runner."""

    poll: float = 0.2  # between two checks of the child and of the user's requests
    wait_poll: float = 2.0  # between two checks of a queue in which no item can start yet
    probe_every: float = 30.0  # between two readings of a bench for a condition on a channel
    in_use_seconds: float = 20.0  # until an item tries again to start on a bench in use
    probe_seconds: float = 60.0  # a reading takes one connection and one block
    check_seconds: float = 1800.0  # the longest proof; the shipped ones take seconds
    recover_seconds: float = 3600.0  # an archive of hours is written and verified at disk speed
    identify_seconds: float = 3600.0  # of the largest run
    stop_seconds: float = 600.0  # to zero the outputs and write the archive before it is killed
    lost_in_a_row: int = 2  # consecutive losses of the device after which the queue stops


@dataclass(frozen=True)
class QueueReport:
    """Result of a runner: exit code, reason, and the ended items in order."""

    code: int
    reason: str
    ended: tuple[Item, ...]


class _Ending(Exception):
    """The queue stops, with an exit code and a reason."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


def folder_of(queue: Path) -> Path:
    """Return the folder beside a queue file for its locks and logs."""
    return queue.with_name(queue.name + ".d")


def runner_of(queue: Path) -> int | None:
    """Return the id of the process that runs a queue, None if there is none."""
    path = folder_of(queue) / "runner.lock"
    return holder(path) if held(path) else None


def item_lock(queue: Path, number: int) -> Path:
    """Return the lock file that an item's process holds while it runs."""
    return folder_of(queue) / f"item-{number}.lock"


def log_of(queue: Path, item: Item) -> Path:
    """Return the log of an item's latest attempt."""
    return folder_of(queue) / f"item-{item.id}-{item.attempt}.log"


def end_orphan(queue: Path, item: Item) -> bool:
    """Ask an item's process to end if no runner watches it; return whether there was one."""
    if runner_of(queue) is not None or not held(item_lock(queue, item.id)):
        return False
    pid = _pid_of(item)
    if pid is not None:
        processes.ask_to_end(pid)
    return pid is not None


def _pid_of(item: Item) -> int | None:
    if item.pid is not None:
        return item.pid
    owner = runstate.read_owner(Path(item.run))
    return owner.pid if owner is not None and runstate.owner_alive(owner) else None


class Runner:
    """Runs a queue; a context manager that holds the queue's lock.

    `program` starts a verb (default: this `bramah`). Raises InputError on entry if another
    process runs the queue.
    """

    def __init__(
        self, queue: QueueStore, say: Say, hook: Hook, *, serve: bool = False,
        program: Sequence[str] = processes.BRAMAH, settings: QueueSettings | None = None,
    ) -> None:  # fmt: skip
        self._queue = queue
        self._say = say
        self._hook = hook
        self._serve = serve
        self._program = tuple(program)
        self._settings = settings or QueueSettings()
        self._stop = StopFlag()
        self._lock: LockFile | None = None
        self._ended: list[Item] = []
        self._stops_seen = 0  # [ns] time of the start, or of the last stop that is the runner's
        self._endpoints: dict[tuple[str, str], str] = {}  # of the benches of items begun
        self._lost = 0  # consecutive losses of the device
        self._in_use: dict[tuple[str, str], tuple[float, str]] = {}
        self._readings: dict[tuple[str, str], tuple[float, dict[str, float] | str]] = {}
        self._announced: dict[int, str] = {}

    def __enter__(self) -> Self:
        path = folder_of(self._queue.path) / "runner.lock"
        stale = holder(path)
        try:
            self._lock = LockFile.take(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be locked: {error.strerror}") from error
        if self._lock is None:
            raise InputError(
                f"{self._queue.path}: process {holder(path)} runs this queue already; "
                "`bramah queue pause` stops it after the present item"
            )
        self._stops_seen = path.stat().st_mtime_ns  # by the clock of the files of stops
        if stale is not None:
            self._say(f"the previous runner, process {stale}, was killed")
        self._stop.install()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.restore()
        self._hook.wait()
        if self._lock is not None:
            with contextlib.suppress(OSError):
                os.ftruncate(self._lock.fileno(), 0)
            self._lock.close()

    def run(self) -> QueueReport:
        """Run until no item can start any more, the queue is paused, or it must stop."""
        self._queue.note("runner begins", f"process {os.getpid()} on {runstate.computer_name()}")
        try:
            self._resolve_leftovers()
            reason = self._loop()
            states = {item.state for item in self._ended}
            code = 4 if it.LOST in states else 1 if states - {it.DONE} else 0
            report = QueueReport(code, reason, tuple(self._ended))
        except OperatorStop as stopped:
            report = QueueReport(130, str(stopped), tuple(self._ended))
        except _Ending as ending:
            report = QueueReport(ending.code, ending.reason, tuple(self._ended))
        self._queue.note("runner ends", report.reason)
        self._notify("end", None, report.reason)
        return report

    def _loop(self) -> str:
        while True:
            self._obey_stop()
            self._identify_due()
            paused = self._queue.paused
            if paused and not self._serve:
                return f"{PAUSED}: {paused}"
            item, verdicts = (None, []) if paused else self._choose()
            if item is not None:
                claimed = self._queue.claim(item.id)
                if claimed is not None:
                    self._start(claimed)
                continue
            waiting = [item for item, verdict in verdicts if not verdict.state]
            if not waiting and not self._serve and not paused:
                return ENDED
            self._pause(self._settings.wait_poll)

    def _stop_reason(self) -> str | None:
        """Return why a person stopped this runner or a bench of its items, None if nobody did."""
        if self._stop.reason is not None:
            return self._stop.reason
        for endpoint in ("", *self._endpoints.values()):
            if latch.stop_time(endpoint) > self._stops_seen:
                return f"`bramah stop` of {endpoint or 'every bench'}"
        return None

    def _heed_stops_of(self, job: QueueJob) -> None:
        """Let a `bramah stop` of a job's bench stop the queue from now on."""
        with contextlib.suppress(InputError):  # the check states what is wrong with the rig file
            endpoint = job.endpoint or load_rig(job.rig).wire.endpoint
            self._endpoints[job.rig, job.endpoint] = endpoint

    def _obey_stop(self) -> None:
        if (reason := self._stop_reason()) is not None:
            raise OperatorStop(reason)

    def _pause(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and self._stop_reason() is None:
            time.sleep(min(self._settings.poll, seconds))

    # Which item

    def _choose(self) -> tuple[Item | None, list[tuple[Item, ready.Readiness]]]:
        items, now = self._queue.items(), datetime.now(UTC)
        item, verdicts = ready.choose(items, now, self._read, self._holder_of)
        for other, verdict in verdicts:
            if verdict.state:
                self._finish(other, ItemOutcome(verdict.state, verdict.reason))
            elif self._announced.get(other.id) != verdict.reason:
                self._announced[other.id] = verdict.reason
                self._say(f"item {other.id} {other.job.name}: {verdict.reason}")
        return item, verdicts

    def _holder_of(self, job: QueueJob) -> str:
        """Return who had a bench when an item was last refused for that, '' after a while."""
        refused_at, holder = self._in_use.get((job.rig, job.endpoint), (-math.inf, ""))
        return holder if time.monotonic() - refused_at < self._settings.in_use_seconds else ""

    def _read(self, job: QueueJob) -> dict[str, float] | str:
        """Return the means of a bench's channels, cached for a while; moves nothing."""
        key = (job.rig, job.endpoint)
        cached = self._readings.get(key)
        if cached is None or time.monotonic() - cached[0] > self._settings.probe_every:
            words = ["probe", *job.bench_words, "--json", "-"]
            answer = self._call_verb(words, self._settings.probe_seconds)
            readings = answer.as_json()
            means: dict[str, float] | str = answer.reason or (
                f"`bramah probe` wrote {answer.output[:60]!r}, not a JSON list of channels"
            )
            if isinstance(readings, list):  # also where the exit code says that one is implausible
                means = {
                    reading["channel"]: float(reading["mean"])
                    for reading in readings
                    if reading["mean"] is not None
                }
            cached = (time.monotonic(), means)
            self._readings[key] = cached
        return cached[1]

    def _call_verb(self, words: Sequence[str], seconds: float) -> processes.ProcessResult:
        return processes.call(self._program, words, seconds, self._stop_reason)

    # One item

    def _start(self, item: Item) -> None:
        """Check a claimed item against the present limits, then run it to its end."""
        self._say(f"item {item.id} {item.job.name}: checking")
        self._heed_stops_of(item.job)
        try:
            proof = self._call_verb(item.job.check_words(), self._settings.check_seconds)
            self._obey_stop()
        except OperatorStop:
            self._queue.release(item.id, "the runner was stopped during its check")
            raise
        if proof.code != 0:
            self._finish(item, outcome_of(proof.code, proof.reason, began=False))
            return
        if self._queue.item(item.id).cancel:
            self._finish(item, ItemOutcome(it.CANCELLED, "cancelled during its check"))
            return
        begun = self._queue.begin(item.id)
        self._conclude(begun, self._run(begun))

    def _run(self, item: Item) -> ItemOutcome:
        """Run an item's process to its end and return the outcome."""
        lock = LockFile.take(item_lock(self._queue.path, item.id))
        if lock is None:
            return ItemOutcome(
                it.FAILED, "a process of this item still runs; the item was not started again"
            )
        self._say(f"item {item.id} {item.job.name}: running into {item.run}")
        path = log_of(self._queue.path, item)
        words = [*self._program, *item.job.run_words(item.run)]
        with path.open("wb") as output:
            child = processes.start(words, output, subprocess.STDOUT, lock)
        try:
            self._queue.note_process(item.id, child.pid)
            request = self._watch(item, lambda: child.poll() is not None, lambda: child.pid)
        except BaseException:
            # After any error of the runner, the child first makes the bench safe.
            processes.ask_to_end(child.pid)
            child.wait()
            raise
        began = store.is_run(Path(item.run))
        outcome = outcome_of(child.returncode, processes.reason_of(path), began=began)
        return outcome.as_requested(request, self._why(request))

    def _watch(self, item: Item, ended: Callable[[], bool], pid: Callable[[], int | None]) -> str:
        """Wait until a process has ended; return the state for which it was asked to end, or ''."""
        requested, requested_at = "", 0.0
        while not ended():
            end_state = it.STOPPED if self._stop_reason() else ""
            if not end_state and self._queue.item(item.id).cancel:
                end_state = it.CANCELLED
            process = pid()
            if end_state and not requested and process is not None:
                self._say(f"item {item.id} {item.job.name}: asked to end")
                processes.ask_to_end(process)
                requested, requested_at = end_state, time.monotonic()
            overdue = time.monotonic() - requested_at > self._settings.stop_seconds
            if requested and process and overdue:
                log.error("item %d: did not end within %g s and is killed", item.id,
                          self._settings.stop_seconds)  # fmt: skip
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
                requested_at = time.monotonic()
            time.sleep(self._settings.poll)
        return requested

    def _conclude(self, item: Item, outcome: ItemOutcome) -> None:
        """Finish an item, recover its run if its process died, and stop the queue if necessary."""
        if outcome.in_use:
            key = (item.job.rig, item.job.endpoint)
            self._in_use[key] = (time.monotonic(), outcome.reason)
            self._queue.release(item.id, f"not started: {outcome.reason}")
            return
        if outcome.latched:
            self._queue.release(item.id, f"not started: {outcome.reason}")
            self._notify("trip", self._queue.item(item.id), outcome.reason)  # queued again
            raise _Ending(3, outcome.reason)
        if outcome.state == it.INTERRUPTED:
            outcome = self._make_safe(item, outcome)
        if self._unfinished(item):
            outcome = self._recover(item, outcome)
        self._finish(item, outcome)
        self._lost = self._lost + 1 if outcome.state == it.LOST else 0
        if UNSURE in outcome.reason:
            raise _Ending(4, f"item {item.id}: {outcome.reason}")
        if outcome.state == it.TRIPPED:
            raise _Ending(3, f"item {item.id} tripped: {outcome.reason}")
        if self._lost >= self._settings.lost_in_a_row:
            raise _Ending(4, f"the device was lost {self._lost} times in a row: {outcome.reason}")
        self._obey_stop()
        if outcome.state == it.STOPPED:
            raise _Ending(130, f"item {item.id} was stopped: {outcome.reason}")

    def _make_safe(self, item: Item, outcome: ItemOutcome) -> ItemOutcome:
        """Zero the outputs of a bench whose process died; the watchdog has probably done so."""
        words = ["stop", *item.job.bench_words]
        self._heed_stops_of(item.job)
        by_person = self._stop_reason() is not None
        answer = processes.call(self._program, words, self._settings.probe_seconds)
        if not by_person:  # the stop that was just stored is the runner's
            stops = map(latch.stop_time, self._endpoints.values())
            self._stops_seen = max([self._stops_seen, *stops])
        if answer.code == 0:
            return outcome.adding("outputs confirmed at zero")
        # Without the phrase that stops the queue: the next item tests whether the bench answers.
        return outcome.adding(f"outputs left to the watchdog: {answer.reason.replace(UNSURE, '')}")

    def _unfinished(self, item: Item) -> bool:
        folder = Path(item.run)
        return store.is_run(folder) and (
            (folder / runstate.JOURNAL).exists() or runstate.read_owner(folder) is not None
        )

    def _recover(self, item: Item, outcome: ItemOutcome) -> ItemOutcome:
        # A request to end does not interrupt this, so that the recorded data are safe.
        answer = processes.call(
            self._program, ["recover", item.run], self._settings.recover_seconds
        )
        if answer.code == 0:
            return outcome.adding(f"recovered: {answer.output.strip()}")
        return outcome.adding(f"recover: {answer.reason}")

    def _finish(self, item: Item, outcome: ItemOutcome) -> None:
        ended = self._queue.finish(item.id, outcome.state, outcome.reason)
        self._ended.append(ended)
        why = f": {outcome.reason}" if outcome.reason else ""
        self._say(f"item {item.id} {item.job.name}: {outcome.state}{why}")
        if outcome.state == it.TRIPPED:
            self._notify("trip", ended, outcome.reason)
        elif outcome.state not in (it.DONE, it.CANCELLED, it.STOPPED):
            self._notify("failure", ended, outcome.reason)

    def _identify_due(self) -> None:
        """Identify from the finished runs, for conditions on their results and for the page."""
        for item in self._queue.items():
            if item.state != it.DONE or not item.job.identify or item.results:
                continue
            self._say(f"item {item.id} {item.job.name}: identifying")
            words = ["identify", item.run, "--json", "-"]
            answer = self._call_verb(words, self._settings.identify_seconds)
            result = answer.as_json() if answer.code == 0 else None
            why = answer.reason or "no result"
            self._queue.keep_results(
                item.id, result if isinstance(result, dict) else {"error": why}
            )

    # Items of an earlier runner

    def _resolve_leftovers(self) -> None:
        for item in self._queue.items():
            if item.state == it.CHECKING:
                self._queue.release(item.id, "the runner ended during its check")
            elif item.state == it.RUNNING:
                self._conclude(item, self._outcome_unwatched(item))

    def _outcome_unwatched(self, item: Item) -> ItemOutcome:
        lock = item_lock(self._queue.path, item.id)
        request = it.CANCELLED if item.cancel else ""
        if held(lock):
            self._say(
                f"item {item.id} {item.job.name}: its process still runs; waiting for its end"
            )
            request = self._watch(item, lambda: not held(lock), lambda: _pid_of(item)) or request
        message = processes.reason_of(log_of(self._queue.path, item))
        return outcome_of_folder(Path(item.run), message).as_requested(request, self._why(request))

    def _why(self, request: str) -> str:
        """Return why a process was asked to end, for the state that was requested."""
        return "cancelled by a person" if request == it.CANCELLED else self._stop_reason() or ""

    def _notify(self, event: str, item: Item | None, reason: str) -> None:
        counts = Counter(other.state for other in self._queue.items())
        about: dict[str, Any] | None = None
        if item is not None:
            about = {
                "id": item.id, "name": item.job.name, "state": item.state, "run": item.run,
                "protocol": item.job.protocol, "rig": item.job.rig, "attempt": item.attempt,
            }  # fmt: skip
        self._hook.send(
            {
                "event": event,
                "time": runstate.utc_now(),
                "host": runstate.computer_name(),
                "queue": str(self._queue.path),
                "reason": reason,
                "item": about,
                "counts": dict(counts),
            }
        )
